"""Files of penetration models, tables of their predictions, and export to ONNX.

A model file is JSON with numbers and names; nothing in it is ever executed.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from labapp.config.toml_keys import Rule, between, is_number, one_of, shown, whole, within
from labapp.core.dynamics.penetration import ModelSettings, PenetrationModel, Prediction
from labapp.core.dynamics.static_maps import MOST_POINTS, GaussianMap, LinearMap
from labapp.core.dynamics.weld_series import LONGEST_MEMORY, MOST_HELD, Orders, WeldSeries
from labapp.core.surface.measures import WITH_SIGMA, sigma_name
from labapp.core.values import FloatArray
from labapp.errors import InputError, parser_words
from labapp.export.features import needs_extra, weld_series
from labapp.export.frame_result import FrameResult
from labapp.files import as_bytes, read_limited, write_file
from labapp.text import csv_text, number_cell, pluralize
from labapp.version import VERSION

FORMAT = 1

LARGEST = 1 << 25
"""Largest model file, bytes."""

MOST = 1e12
"""Limit of the numbers in arrays."""

WANTED = "a penetration model, as `labapp penetration fit` writes it"

OPSET, IR_VERSION = 17, 8
"""Versions of ONNX graphs, supported by runtimes since 2022."""


# --- files --------------------------------------------------------------------------------------


def write_model(path: str | os.PathLike[str], model: PenetrationModel) -> None:
    """Write a model as JSON.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    settings, static = model.settings, model.static
    content = {
        "program": "labapp",
        "version": VERSION,
        "format": FORMAT,
        "kind": model.kind,
        **asdict(settings),
        **{key: getattr(model, key) for key in ("time_constants_s", *ARRAYS, *NUMBERS)},
        "static": asdict(static) if isinstance(static, LinearMap) else _fields(static),
    }
    write_file(Path(path), as_bytes(json.dumps(content, default=_listed, indent=1) + "\n"))


ARRAYS = ("center", "scale", "low", "high")
NUMBERS = ("mean_mm", "scatter_mm", "factor", "rmse_mm")


def _fields(static: GaussianMap) -> dict[str, Any]:
    """Return the fields of a map, without its cache."""
    return {name: getattr(static, name) for name in GaussianMap.__dataclass_fields__}


def _listed(value: Any) -> Any:
    return value.tolist()


def read_model(path: str | os.PathLike[str]) -> PenetrationModel:
    """Read a model that `write_model` wrote.

    Raises
    ------
    InputError
        If it is not a model, or anything in it is invalid.
    """
    path = Path(path)
    try:
        read = json.loads(read_limited(path, LARGEST, WANTED))
    except (ValueError, RecursionError) as error:
        raise InputError(path, "syntax", parser_words(error), WANTED) from error
    file = _Fields(path, read)
    file.get("program", one_of("labapp"))
    file.get("format", Rule(f"{FORMAT}, of this labapp", lambda value: value == FORMAT))
    return _model(file)


@dataclass(frozen=True)
class _Fields:
    """The fields of a JSON object of a file, checked one by one; errors have their full name."""

    path: Path
    content: Any
    name: str = ""
    """Name of the object; empty for the outermost."""

    def __post_init__(self) -> None:
        if not isinstance(self.content, dict):
            raise self.error("", shown(self.content), WANTED)

    def error(self, key: str, value: object, expected: str) -> InputError:
        """Return the error for a field; for the object itself without a key."""
        field = ".".join(filter(None, (self.name, key)))
        return InputError(self.path, field or "content", value, expected)

    def get(self, key: str, rule: Rule) -> Any:
        """Return a value that a rule accepts."""
        if key not in self.content:
            raise self.error(key, "missing", rule.expected)
        value = self.content[key]
        if not rule.accepts(value):
            raise self.error(key, shown(value), rule.expected)
        return value

    def part(self, key: str) -> _Fields:
        """Return the fields of an object in this one."""
        value = self.get(key, Rule("an object with fields", lambda value: isinstance(value, dict)))
        return _Fields(self.path, value, key)

    def array(self, key: str, *shape: int, above: float = -MOST) -> FloatArray:
        """Return an array of finite numbers above a limit."""
        numbers = f"{' × '.join(map(str, shape))} numbers above {above:g} and below {MOST:g}"
        values = self.get(key, Rule(numbers, lambda value: isinstance(value, list)))
        for place, wrong in _wrong(values, above, shape):
            raise self.error(key + place, wrong, numbers)
        return np.array(values, float)


def _wrong(value: object, above: float, shape: tuple[int, ...]) -> Iterator[tuple[str, str]]:
    """Yield place and value of items that are no numbers above a limit, or no lists of a shape.

    Checked before NumPy sees them: a single long text would make an array of such texts.
    """
    if not shape:
        if not (
            isinstance(value, int | float) and not isinstance(value, bool) and above < value < MOST
        ):
            yield "", shown(value)
    elif not isinstance(value, list):
        yield "", shown(value)
    elif len(value) != shape[0]:
        yield "", pluralize(len(value), "value")
    else:
        for k, one in enumerate(value):
            for place, wrong in _wrong(one, above, shape[1:]):
                yield f"[{k}]{place}", wrong


def _model(file: _Fields) -> PenetrationModel:
    """Return the model described by the fields of a file."""
    kind = file.get("kind", one_of("arx", "gp"))
    target = file.get("target", TARGET)
    settings = ModelSettings(
        tuple(file.get("features", FEATURES)),
        target,
        file.get("step_s", within(1e-4, 100, "s")),
        Orders(**{key: file.part("orders").get(key, rule) for key, rule in ORDERS.items()}),
        file.get("full_mm", FULL_MM),
    )
    orders = settings.orders
    right = f"{orders.poles} numbers above 0 and up to 1000 (s)"
    constants = tuple(file.get("time_constants_s", Rule(right, _are_time_constants)))
    if len(constants) != orders.poles:
        raise file.error("time_constants_s", shown(constants), f"{right}, as orders.poles says")
    memory = 8 * sum(constants) / settings.step_s + orders.delay + orders.lags
    if memory > LONGEST_MEMORY:
        least = f"{LONGEST_MEMORY} steps or fewer, with the present time_constants_s and step_s"
        raise file.error("orders", f"a memory of {memory:.0f} steps", least)
    width = orders.lags * len(settings.features)
    static = _static(file.part("static"), kind, width)
    center, low, high = (file.array(key, width) for key in ("center", "low", "high"))
    scale = file.array("scale", width, above=0)
    if (low > high).any():
        raise file.error("low", "above high", "the lower ends of the range, below those of high")
    mean, *others = (float(file.get(key, within(0, 1e9, ""))) for key in NUMBERS)
    return PenetrationModel(
        kind, settings, constants, center, scale, low, high, mean, static, *others
    )


def _static(fields: _Fields, kind: str, width: int) -> LinearMap | GaussianMap:
    """Return the map from ``width`` regressors to penetration."""
    if kind == "arx":
        weights = fields.array("weights", width + 1)
        covariance = fields.array("covariance", width + 1, width + 1)
        if not _is_covariance(covariance):
            right = "a covariance matrix: symmetric, without negative eigenvalues"
            raise fields.error("covariance", "another matrix", right)
        return LinearMap(weights, covariance)
    right = f"1 to {MOST_POINTS} numbers"
    listed = Rule(right, lambda value: isinstance(value, list) and 0 < len(value) <= MOST_POINTS)
    count = len(fields.get("values", listed))
    values = fields.array("values", count)  # first, as it determines the shape of the others
    static = GaussianMap(
        fields.array("points", count, width),
        values,
        fields.array("variances", count, above=0),
        fields.array("lengths", width, above=0),
        float(fields.get("signal", between(0, 1e9, "mm²"))),
    )
    with contextlib.suppress(ValueError):  # from SciPy, of a singular covariance
        if np.isfinite(static.weights).all():
            return static
    right = "points, variances, lengths and signal with a positive definite covariance"
    raise fields.error("points", "singular covariance", right)


def _is_covariance(matrix: FloatArray) -> bool:
    rounding = 1e-9 * np.abs(matrix).max()
    is_symmetric = np.abs(matrix - matrix.T).max() <= rounding
    return bool(is_symmetric and np.linalg.eigvalsh(matrix).min() >= -rounding)


def _are_features(value: object) -> bool:
    if not (isinstance(value, list) and all(isinstance(one, str) for one in value)):
        return False
    return 0 < len(set(value)) == len(value) and set(value) <= set(WITH_SIGMA)


def _are_time_constants(value: object) -> bool:
    return isinstance(value, list) and all(is_number(one) and 0 < one <= 1000 for one in value)


def _is_target(value: object) -> bool:
    return isinstance(value, str) and value.replace("_", "").isalnum() and len(value) <= 50


FEATURES = Rule(f"different names, some of {', '.join(WITH_SIGMA)}", _are_features)
TARGET = Rule("a name of letters, digits and _, at most 50", _is_target)
FULL_MM = Rule(
    "null or a number above 0 (mm)", lambda value: value is None or (is_number(value) and value > 0)
)
ORDERS = {
    "poles": whole(0, 2),
    "lags": whole(1, LONGEST_MEMORY),
    "delay": whole(0, LONGEST_MEMORY),
}


# --- predictions --------------------------------------------------------------------------------


def prediction_csv(name: str, model: PenetrationModel, found: Mapping[str, Prediction]) -> str:
    """Return predictions of recordings as CSV; the model's columns begin with ``model``.

    Parameters
    ----------
    found
        Predictions by the recording's name.
    """
    target = f"model_{model.settings.target}"
    ends = (f"model_low_95_{_unit(target)}", f"model_high_95_{_unit(target)}")
    rows: list[list[str]] = [
        ["recording", "time_s", target, sigma_name(target), *ends, "model_status", "model"]
    ]
    for recording, one in found.items():
        columns = one.time_s, one.value, one.sigma, one.low_95, one.high_95
        for values, outside in zip(np.column_stack(columns), one.is_outside, strict=True):
            status = "extrapolated" if outside else "ok" if np.isfinite(values[1]) else "unknown"
            rows.append([recording, *map(number_cell, values.tolist()), status, name])
    return csv_text(rows)


def _unit(name: str) -> str:
    return name.rpartition("_")[2]


class Predictor:
    """Online prediction, step by step, with the same results as `PenetrationModel.predict`.

    Parameters
    ----------
    keeps
        Whether to store all predictions for `predictions`.
    """

    def __init__(self, name: str, model: PenetrationModel, *, keeps: bool = True) -> None:
        self.name, self.model = name, model
        self._frames: list[WeldSeries] = []
        self._ended: deque[Prediction] = deque(maxlen=None if keeps else 1)
        self._step = -(1 << 62)

    def add(self, result: FrameResult) -> None:
        """Add the next frame.

        Raises
        ------
        InputError
            If it has no time.
        """
        if result.time_s is None:
            raise InputError("--model", "time", "unknown", "a recording that has a time base")
        step = math.floor(result.time_s / self.model.settings.step_s + 1e-9)
        if not 0 <= step - self._step <= LONGEST_MEMORY:  # at the start, or if the clock was reset
            self._frames, self._step = [], step
        elif step > self._step:
            self._end_step(step)
        self._frames.append(frame_features(result, self.model.settings.features))

    def _end_step(self, step: int) -> None:
        """Predict the steps before this one, and discard frames that are no longer needed."""
        step_s, last = self.model.settings.step_s, self._step
        if any(np.isfinite(one.value).all() for one in self._frames):
            none = np.full((1, len(self.model.settings.features)), np.nan)
            until = np.array([(step - 0.5) * step_s])  # includes steps without a frame
            end = WeldSeries("", until, none, none, none, none[:, 0], none[:, 0])
            found = self.model.predict(joined([*self._frames, end]))
            new = found.time_s > last * step_s
            self._ended.append(Prediction(*(of[new] for of in vars(found).values())))
        elif self._ended:
            unknown = np.full(1, np.nan)
            time_s = np.array([(last + 0.5) * step_s])
            self._ended.append(Prediction(time_s, unknown, unknown, np.zeros(1, bool)))
        first = (step - self.model.memory - MOST_HELD - 1) * step_s
        self._frames = [one for one in self._frames if one.time_s[0] >= first]
        self._step = step

    def predictions(self) -> Prediction | None:
        """Return all predictions, including the unfinished step; None if there are none."""
        self._end_step(self._step + 1)
        if not self._ended:
            return None
        columns = zip(*(vars(one).values() for one in self._ended), strict=True)
        return Prediction(*map(np.concatenate, columns))

    @property
    def newest(self) -> tuple[float, float, bool]:
        """Penetration and ± at the last finished step, mm, and whether they are extrapolated.

        NaN if unknown.
        """
        if not self._ended:
            return math.nan, math.nan, False
        last = self._ended[-1]
        return float(last.value[-1]), float(last.sigma[-1]), bool(last.is_outside[-1])

    def values(self) -> dict[str, float | str | None]:
        """Return the newest prediction as values of a stream, with names `streams.PENETRATION`."""
        value, sigma, is_outside = self.newest
        known = math.isfinite(value)
        return {
            "penetration_mm": value if known else None,
            "penetration_sigma_mm": sigma if known else None,
            "penetration_model": f"{self.name} {self.model.settings.target}"
            + " extrapolated" * is_outside,
        }


def frame_features(result: FrameResult, features: Collection[str]) -> WeldSeries:
    """Return the features of one frame as a series of length 1; NaN without a surface."""
    found = result.measurement
    sizes = vars(found.measures) if found.measures else dict.fromkeys(WITH_SIGMA, math.nan)
    columns = {name: np.array([value]) for name, value in sizes.items()}
    time_s = np.array([math.nan if result.time_s is None else result.time_s])
    return weld_series("", time_s, columns, tuple(features))


def joined(parts: Iterable[WeldSeries]) -> WeldSeries:
    """Concatenate series."""
    columns = zip(*(list(vars(one).values())[1:] for one in parts), strict=True)
    return WeldSeries("", *(np.concatenate(column) for column in columns))


# --- ONNX ---------------------------------------------------------------------------------------


def write_onnx(path: Path, model: PenetrationModel) -> None:
    """Write a model, without its ±, as an ONNX graph of standard operators (float64).

    Input ``features``, shape (memory, k): mean of each step up to the present, oldest first, in the
    order of the metadata ``features``. Output ``value``, shape (1,), mm.

    Raises
    ------
    InputError
        If it cannot be written, or the package onnx is missing.
    """
    try:
        import onnx
        from onnx import TensorProto, helper, numpy_helper
    except ImportError as error:
        raise needs_extra("onnx") from error
    settings = model.settings
    orders, width = settings.orders, len(settings.features)
    kernel = np.zeros((orders.lags, model.memory))
    for lag in range(orders.lags):
        end = model.memory - orders.delay - lag
        kernel[lag, end - len(model.response) : end] = model.response[::-1]
    constants: dict[str, Any] = {
        "kernel": kernel,
        "row": np.array([1, orders.lags * width]),
        "center": model.center,
        "scale": model.scale,
        "mean": np.array([model.mean_mm]),
    }
    nodes = [
        ("MatMul", "kernel features", "filtered"),
        ("Reshape", "filtered row", "regressors"),
        ("Sub", "regressors center", "centred"),
        ("Div", "centred scale", "x"),
    ]
    more, operators = _static_graph(model.static)
    constants |= more
    nodes += operators
    constants["flat"] = np.array([1])
    nodes += [
        ("Reshape", "sum flat", "deviation"),
        ("Add", "deviation mean", "signed"),
        ("Relu", "signed", "value"),
    ]
    real = TensorProto.DOUBLE
    graph = helper.make_graph(
        [helper.make_node(kind, given.split(), [out]) for kind, given, out in nodes],
        "penetration",
        [helper.make_tensor_value_info("features", real, [model.memory, width])],
        [helper.make_tensor_value_info("value", real, [1])],
        [numpy_helper.from_array(np.asarray(of), name) for name, of in constants.items()],
    )
    exported = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)])
    exported.ir_version = IR_VERSION
    facts = {"features": " ".join(settings.features), "step_s": f"{settings.step_s:g}"}
    helper.set_model_props(exported, {**facts, "target": settings.target, "program": "labapp"})
    onnx.checker.check_model(exported)
    write_file(path, exported.SerializeToString())


def _static_graph(
    static: LinearMap | GaussianMap,
) -> tuple[dict[str, FloatArray], list[tuple[str, str, str]]]:
    """Return constants and operators (kind, inputs, output) from ``x``, (1, d), to ``sum``."""
    if isinstance(static, LinearMap):
        constants = {"weights": static.weights[:-1, None], "constant": static.weights[-1:]}
        return constants, [("MatMul", "x weights", "product"), ("Add", "product constant", "sum")]
    constants = {
        "points": static.points,
        "lengths": static.lengths,
        "one": np.ones((static.points.shape[1], 1)),
        "half": np.array([-0.5]),
        "weights": static.signal * static.weights[None, :],
    }
    return constants, [
        ("Sub", "x points", "difference"),
        ("Div", "difference lengths", "distance"),
        ("Mul", "distance distance", "square"),
        ("MatMul", "square one", "squares"),
        ("Mul", "squares half", "exponent"),
        ("Exp", "exponent", "covariance"),
        ("MatMul", "weights covariance", "sum"),
    ]
