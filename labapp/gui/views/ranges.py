"""A field for a range: minimum and maximum of a quantity side by side."""

from __future__ import annotations

from labapp.gui.widgets.fields import Field, NumberField
from labapp.gui.widgets.layouts import row_of


class RangeField(Field):
    """Two numbers with one unit; ``edited`` carries both."""

    def __init__(
        self,
        label: str,
        unit: str = "",
        *,
        lowest: float,
        highest: float,
        step: float = 1.0,
        tooltip: str = "",
    ) -> None:
        self.least, self.most = (
            NumberField(
                f"{label}, {end}",
                unit,
                lowest=lowest,
                highest=highest,
                step=step,
                tooltip=f"{tooltip}: {end}",
            )
            for end in ("least", "most")
        )
        pair = row_of((self.least, 1), (self.most, 1))
        for field in (self.least, self.most):
            field.unit.hide()  # shown once, after both
            field.edited.connect(self._emit_change)
        super().__init__(label, pair, tooltip, unit)
        pair.setFocusProxy(self.least)

    def value(self) -> tuple[float, float]:
        """Minimum and maximum."""
        return self.least.value() or 0.0, self.most.value() or 0.0

    def set_value(self, ends: tuple[float, float]) -> None:
        """Show another range without a signal."""
        self.least.set_value(ends[0])
        self.most.set_value(ends[1])
        self._judge()

    def _emit_change(self) -> None:
        self._judge()
        self.edited.emit(self.value())

    def _judge(self) -> None:
        least, most = self.value()
        self.set_problem("The smaller number comes first" if least > most else "")
