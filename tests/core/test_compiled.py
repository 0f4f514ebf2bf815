"""Freshly compiled and cached code give bitwise identical results."""

import os
import subprocess
import sys
from contextlib import ExitStack

import pytest
from filelock import FileLock

from labapp.core import compiled
from tests.waiting import PATIENCE_S

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
def test_cached_code_computes_the_same_as_freshly_compiled_code(tmp_path):
    """By default numba would call different copies of ``_moments`` in the two processes."""
    (tmp_path / "loops.py").write_text(LOOPS, "utf-8")
    cache = tmp_path / "cache"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-c", USE]
    outputs, cached = [], []
    for _ in range(2):
        with ExitStack() as compiling:  # another process compiles: the second one need not wait
            for lock in cache.rglob("lock"):
                compiling.enter_context(FileLock(lock))
            done = subprocess.run(
                command,
                capture_output=True,
                text=True,
                check=True,
                env=environment,
                timeout=PATIENCE_S,
            )
        outputs.append(done.stdout)
        cached.append({path.name: path.stat().st_mtime_ns for path in cache.rglob("*.nbc")})
    assert cached[0]
    assert cached[0] == cached[1], "the second one is to load what the first one compiled"
    assert outputs[0] == outputs[1]


CALLER = """
import numpy as np
from loops import _f2, compiled, moments


@compiled(_f2)
def total(values):
    return moments(values, np.ones_like(values)).sum()
"""

CALL = """
import numpy as np
from loops import moments
from callers import total

values = np.linspace(0.0, 1.0, 12).reshape(3, 4)
print(np.isclose(total(values), moments(values, np.ones((3, 4))).sum(), rtol=1e-12))
"""


@pytest.mark.slow
def test_a_caller_of_cached_code_can_be_compiled(tmp_path):
    (tmp_path / "loops.py").write_text(LOOPS, "utf-8")
    (tmp_path / "callers.py").write_text(CALLER, "utf-8")
    environment = os.environ | {
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": str(tmp_path),
    }
    for commands in ("import loops", CALL, CALL):
        command = [sys.executable, "-c", commands]
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == "True\n"


def test_cache_key_depends_on_imported_sources_and_numba_version(tmp_path, monkeypatch):
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
    module = ("package.own_kernels", package / "own_kernels.py")
    digests = [compiled._digest(*module)]
    for name, source in files.items():
        (package / name).write_text(source + "MORE = 2\n", "utf-8")
        digests.append(compiled._digest(*module))
    assert len(set(digests)) == 4, "all but the one that is not imported"
    assert digests[-1] == digests[-2]
    monkeypatch.setattr("numba.__version__", "0.0")
    assert compiled._digest(*module) not in digests, "another numba discards what this one kept"
