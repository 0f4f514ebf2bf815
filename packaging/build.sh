#!/bin/sh
# Freeze labapp with the environment that `./run build` made, and pack what this system can:
# a folder and an archive everywhere, a .deb where dpkg-deb is.
set -eu
root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd -P)
python=$1
out=$root/build/packages
version=$("$python" -c 'from labapp import __version__; print(__version__)')
cd "$root"
rm -rf "$out"
mkdir -p "$out"
"$python" -m PyInstaller --noconfirm --log-level WARN --distpath build/frozen \
    --workpath build/pyinstaller packaging/labapp.spec
# Symbols for debuggers are a tenth of the folder. Libraries that auditwheel changed (*.libs) stay as they are.
for package in vtkmodules pyarrow numcodecs llvmlite; do
    find "build/frozen/labapp/_internal/$package" -type f \( -name '*.so' -o -name '*.so.*' \) \
        -exec strip --strip-unneeded {} +
done
tar -C build/frozen -czf "$out/labapp-$version-linux-$(uname -m).tar.gz" labapp

if command -v dpkg-deb >/dev/null; then
    tree=$root/build/deb
    rm -rf "$tree"
    mkdir -p "$tree/DEBIAN" "$tree/opt" "$tree/usr/bin" "$tree/usr/share/applications" \
        "$tree/usr/share/mime/packages" "$tree/usr/share/icons/hicolor/scalable/apps" \
        "$tree/usr/lib/udev/rules.d"
    cp -r build/frozen/labapp "$tree/opt/labapp"
    ln -s /opt/labapp/labapp "$tree/usr/bin/labapp"
    cp packaging/labapp.desktop "$tree/usr/share/applications/"
    cp packaging/labapp-mime.xml "$tree/usr/share/mime/packages/labapp.xml"
    cp resources/icons/labapp.svg "$tree/usr/share/icons/hicolor/scalable/apps/"
    cp resources/udev/70-labapp.rules "$tree/usr/lib/udev/rules.d/"
    cat >"$tree/DEBIAN/control" <<CONTROL
Package: labapp
Version: $version
Architecture: $(dpkg --print-architecture)
Maintainer: labapp contributors <labapp@localhost>
Section: science
Priority: optional
Installed-Size: $(du -sk "$tree" | cut -f1)
Depends: libstdc++6, libegl1, libgl1, libglib2.0-0 | libglib2.0-0t64, libxkbcommon0, libfontconfig1, libdbus-1-3, libxcb-cursor0, libxcb-icccm4, libxcb-keysyms1, libxcb-shape0, libxkbcommon-x11-0, libxcursor1
Recommends: libaravis-0.8-0
Description: surface of a molten weld pool, measured from reflected laser dots
 A desktop application and a command line: calibration, recording,
 reconstruction in three dimensions with uncertainties, export.
CONTROL
    dpkg-deb --root-owner-group -Zxz -z1 --build "$tree" "$out" >/dev/null
fi
ls -lh "$out"
