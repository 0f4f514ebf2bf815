; Inno Setup: the installer for Windows, made of what PyInstaller froze there:
;   uv sync --locked --all-extras --no-default-groups --group build --no-editable
;   uv run --no-sync pyinstaller --distpath build\frozen --workpath build\pyinstaller packaging\labapp.spec
;   iscc /DVersion=1.0.0 packaging\labapp.iss
#ifndef Version
  #error Give the version: iscc /DVersion=1.0.0
#endif
[Setup]
AppName=labapp
AppVersion={#Version}
AppPublisher=labapp contributors
DefaultDirName={autopf}\labapp
DefaultGroupName=labapp
OutputDir=..\build\packages
OutputBaseFilename=labapp-{#Version}-windows
ChangesAssociations=yes
PrivilegesRequiredOverridesAllowed=dialog
ArchitecturesInstallIn64BitMode=x64compatible
[Files]
Source: "..\build\frozen\labapp\*"; DestDir: "{app}"; Flags: recursesubdirs ignoreversion
[Icons]
Name: "{group}\labapp"; Filename: "{app}\labapp.exe"
[Registry]
Root: HKA; Subkey: "Software\Classes\.labsession"; ValueType: string; ValueData: "labapp.session"; Flags: uninsdeletevalue
Root: HKA; Subkey: "Software\Classes\labapp.session"; ValueType: string; ValueData: "labapp session"; Flags: uninsdeletekey
Root: HKA; Subkey: "Software\Classes\labapp.session\shell\open\command"; ValueType: string; ValueData: """{app}\labapp.exe"" ""%1"""
