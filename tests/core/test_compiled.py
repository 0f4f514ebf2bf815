"""What is compiled here and what was compiled before compute the same, to the bit."""

import os
import subprocess
import sys

import pytest

from labapp.core import compiled

LOOPS = """
import numpy as np
from numba import types

from labapp.core.compiled import compiled, inner

_f2 = types.Array(types.float64, 2, "C", readonly=True)


@inner
def _moments(values, weights, made):
    made[:] = 0.0
    for k in range(len(values)):
        value, weight = values[k], weights[k]
        made[0] += weight
        made[1] += weight * value
        made[2] += weight * value * value
        made[3] += weight * value * value * value
    mean = made[1] / made[0]
    for k in range(len(values)):
        away = values[k] - mean
        made[4] += weights[k] * away * away
        made[5] += weights[k] * away * away * away
        made[6] += np.exp(-0.5 * away * away)
    for j in range(7):
        for k in range(7):
            made[7] += made[j] * made[k] / (1.0 + j + k)


@compiled(_f2, _f2)
def moments(values, weights):
    made = np.empty((len(values) + 1, 8))
    for k in range(len(values)):
        _moments(values[k], weights[k], made[k])
    _moments(values[0], weights[-1], made[-1])
    return made
"""

USE = """
import numpy as np
from loops import moments

rng = np.random.default_rng(1)
print(moments(rng.normal(size=(5, 301)), rng.random((5, 301))).tobytes().hex())
"""


@pytest.mark.slow
def test_a_process_that_compiles_computes_what_one_that_loads_does(tmp_path):
    """By itself numba calls another copy of ``_moments`` in the one than in the other."""
    (tmp_path / "loops.py").write_text(LOOPS, "utf-8")
    cache = tmp_path / "cache"
    set_so = os.environ | {"NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-c", USE]
    printed, kept = [], []
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=set_so)
        printed.append(done.stdout)
        kept.append({path.name: path.stat().st_mtime_ns for path in cache.rglob("*.nbc")})
    assert kept[0]
    assert kept[0] == kept[1], "the second one is to load what the first one compiled"
    assert printed[0] == printed[1]


def test_what_is_kept_depends_on_what_was_compiled_and_by_what(tmp_path, monkeypatch):
    package = tmp_path / "package"
    (package / "far").mkdir(parents=True)
    files = {
        "own_kernels.py": "from package.far.near_kernels import near\n",
        "far/near_kernels.py": "from package.last_kernels import last\n",
        "last_kernels.py": "LAST = 1\n",
        "other.py": "OTHER = 1\n",
    }
    for name, source in files.items():
        (package / name).write_text(source, "utf-8")
    own = ("package.own_kernels", package / "own_kernels.py")
    found = [compiled._digest(*own)]
    for name, source in files.items():
        (package / name).write_text(source + "MORE = 2\n", "utf-8")
        found.append(compiled._digest(*own))
    assert len(set(found)) == 4, "all but the one that is not imported"
    assert found[-1] == found[-2]
    monkeypatch.setattr("numba.__version__", "0.0")
    assert compiled._digest(*own) not in found, "another numba discards what this one kept"
