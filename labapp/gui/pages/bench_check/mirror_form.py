"""Fields of a mirror: its kind, its sizes and their uncertainties."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from labapp.core.bench_check.mirrors import Plate
from labapp.gui.pages.bench_check.listed_picture import KINDS, ListedPicture
from labapp.gui.widgets.fields import ChoiceField, FieldForm, NumberField


class MirrorForm(FieldForm):
    """Fields of the mirror in the selected picture, which ``change`` gets when it is changed."""

    def __init__(
        self, selected: Callable[[], ListedPicture], change: Callable[[ListedPicture], object]
    ) -> None:
        super().__init__()
        tip = "Which mirror the selected picture shows"
        self.kind = ChoiceField("Mirror", KINDS, tooltip=tip)
        self.kind.edited.connect(lambda kind: change(selected().of_kind(kind)))
        tip = "Of the ball, or of the cap's rim: measure it with a micrometer"
        self.diameter = NumberField(
            "Diameter", "mm", lowest=0.1, highest=1000, step=0.01, decimals=3, tooltip=tip
        )
        self.diameter.edited.connect(lambda value: change(replace(selected(), diameter_mm=value)))
        tip = "Of the plate's surface, or of the top of cap or ball, over the work piece"
        self.height_field = NumberField(
            "Height", "mm", lowest=-100, highest=1000, step=0.01, decimals=3, tooltip=tip
        )
        self.height_field.edited.connect(lambda value: change(replace(selected(), height_mm=value)))
        self.height_sigma = NumberField(
            "Height ±",
            "mm",
            lowest=0.0001,
            highest=100,
            step=0.005,
            decimals=4,
            tooltip="Standard uncertainty of the height; empty: the usual one, in grey",
            optional=True,
        )
        self.height_sigma.edited.connect(
            lambda value: change(replace(selected(), height_sigma_mm=value))
        )
        self.level = NumberField(
            "Level ±",
            "°",
            lowest=0.001,
            highest=10,
            step=0.01,
            decimals=3,
            tooltip="How level the plate lies on the work piece, either way, one standard "
            "uncertainty; empty: the usual one, in grey. It limits what a check can do",
            optional=True,
        )
        self.level.edited.connect(lambda value: change(replace(selected(), level_sigma_deg=value)))
        self.add(*self.fields)

    @property
    def fields(self) -> tuple[ChoiceField | NumberField, ...]:
        """All fields in order."""
        return self.kind, self.diameter, self.height_field, self.height_sigma, self.level

    def show_mirror(self, one: ListedPicture | None, locked: str) -> None:
        """Show the mirror of a picture, or none. ``locked``: reason why changes are refused."""
        for field in self.fields:
            field.lock(locked or ("" if one else "Add a picture first"))
        if one is None:
            return
        self.kind.set_value(one.kind)
        self.height_field.set_value(one.height_mm)
        self.height_field.set_problem(one.problem)
        self.diameter.set_value(one.diameter_mm)
        self.height_sigma.set_value(one.height_sigma_mm)
        self.height_sigma.set_placeholder(f"{one.usual_height_sigma_mm:g}")
        self.level.set_value(one.level_sigma_deg)
        self.level.set_placeholder(f"{Plate.tilt_sigma_deg:g}" if one.kind == "plate" else "")
        if one.kind == "plate":
            self.diameter.lock("A plate has no diameter")
        else:
            self.level.lock("A cap or ball has no level")
