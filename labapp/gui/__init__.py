"""The windows: views know no session, presenters compute what is shown, nothing is stored twice."""

import ctypes
import sys

if sys.version_info < (3, 12):
    # PySide6 6.12.0 returns these without giving them a reference: before 3.12, where they cannot
    # die, the program is aborted after some thousand calls. 6.11 does not do that.
    for immortal in (None, True, False):
        ctypes.c_ssize_t.from_address(id(immortal)).value += 1 << 60
