"""Predictions of a penetration model, shown beside the live sizes and marked as a model's."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from PySide6.QtWidgets import QWidget

from labapp.gui.dialogs import ask_file
from labapp.gui.live.figures import DECIMALS, Figure
from labapp.gui.widgets.buttons import button
from labapp.gui.widgets.labels import Message
from labapp.gui.widgets.layouts import hbox, vbox
from labapp.gui.workspace import Workspace
from labapp.run.live_watch import LiveWatch
from labapp.text import NOTHING, split_unit

if TYPE_CHECKING:
    from labapp.core.dynamics.penetration import PenetrationModel
    from labapp.gui.tasks import Control

MODELS = "Penetration models (*.json)"


class LivePenetration(QWidget):
    """Choice of a model; there is none at every start."""

    def __init__(self, workspace: Workspace, watch: Callable[[], LiveWatch | None]) -> None:
        super().__init__()
        self._workspace, self._watch = workspace, watch
        self._model: tuple[str, PenetrationModel] | None = None
        tip = "Choose a model that labapp penetration fit wrote; it predicts from the live pool"
        self.choose_button = button("Penetration model…", tip, self.choose)
        self.none_button = button("No model", "Stop predicting", lambda: self.set_model(None))
        self.words = Message(2)
        vbox(hbox(self.choose_button, self.none_button), self.words, of=self)
        self.set_model(None)

    def choose(self) -> None:
        """Ask for a model, and use it from the next frame on."""
        path = ask_file(self, "Choose a penetration model", self._workspace.folder, MODELS)
        if path is None:
            return

        def work(_: Control) -> PenetrationModel:
            from labapp.export.penetration import read_model  # loads a large part of SciPy

            return read_model(path)

        def done(model: PenetrationModel) -> None:
            self.set_model((path.stem, model))

        self._workspace.tasks.start("Reading the model", work, done, show_answer=self.words.setText)

    def set_model(self, named: tuple[str, PenetrationModel] | None) -> None:
        """Use another model; None: no model."""
        self._model = named
        self.none_button.setVisible(named is not None)
        words = ""
        if named is not None:
            name, model = named
            words = f"Model {name} ({model.kind}), error {model.rmse_mm:.3f} mm of welds left out"
        self.words.setText(words)
        self.begin()

    def begin(self) -> None:
        """Use the chosen model with the current camera."""
        watch = self._watch()
        if watch is None:
            return
        watch.predictor = None
        if self._model is not None:
            from labapp.export.penetration import Predictor

            watch.predictor = Predictor(*self._model, keeps=False)

    def figures(self, is_old: bool) -> tuple[Figure, ...]:
        """Figure with the prediction of the model; empty without a model."""
        watch = self._watch()
        predictor = None if watch is None else watch.predictor
        if predictor is None:
            return ()
        value, sigma, is_outside = predictor.newest
        words = split_unit(predictor.model.settings.target)[0].capitalize()
        known = math.isfinite(value)
        return (
            Figure(
                words,
                f"{value:.{DECIMALS}f}" if known else NOTHING,
                f"± {sigma:.{DECIMALS}f}" if known else "",
                "◆ model, extrapolated" if is_outside else "model",
                "old" if is_old else "plain",
            ),
        )
