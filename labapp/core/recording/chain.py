"""Frames one after the other: each measured from what the one before left, or else by itself.

The same frames give the same answers: nothing depends on the clock or on how many are measured at
once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from labapp.core.geometry.bench import Bench
from labapp.core.images.dots import Image
from labapp.core.pipeline import Measurement, Settings, measure
from labapp.core.sequence.following import HELD
from labapp.core.sequence.prior import Prior


class WarmChain:
    """Measures the frames of one recording in their order.

    Parameters
    ----------
    bench
        What they were seen on.
    settings
        Of the measurement. Only the fit to band-passed dots, the default, can be followed.
    on_step
        See `pipeline.measure`; called for followed frames.

    Attributes
    ----------
    track_lost
        Why the last frame was measured by itself; None where it was followed.
    """

    def __init__(
        self, bench: Bench, settings: Settings, on_step: Callable[[str], None] = lambda _: None
    ) -> None:
        self.bench, self.settings = bench, settings
        self._on_step = on_step
        self.track_lost: str | None = None
        self._prior: Prior | None = None
        self._after_gap = False

    def skip(self) -> None:
        """Leave out a frame: those before and after it are not equally spaced in time.

        The next frame is sought around the last one, without extrapolation of how the pool swung.
        """
        if self._prior is not None:
            self._prior, self._after_gap = self._prior.after_gap(), True

    def follow(self, image: Image) -> Measurement | None:
        """Measure the next frame from those before; None where they do not lead to it.

        No search is started, and a frame after it may be followed again.
        """
        if self._prior is None:
            self.track_lost = "no frame before it was measured"
            return None
        given = self.bench, self.settings, self._prior
        measurement, prior = measure(image, *given, on_step=self._on_step)
        if prior is None:
            self.track_lost = measurement.reason
            return None
        self._keep(prior)
        self.track_lost = None
        return measurement

    def measure(self, image: Image) -> Measurement:
        """Measure the next frame from those before, or else by itself (`search`)."""
        return self.follow(image) or self.search(image)

    def search(self, image: Image) -> Measurement:
        """Measure the next frame as if it were the first.

        Where that succeeds, those after it may be followed from it.
        """
        self.track_lost = self.track_lost or "it was measured by itself"
        measurement, prior = measure(image, self.bench, self.settings)
        former = self._prior
        if prior is not None and former is not None:
            prior = prior.with_past_of(former, self.bench, self.settings.fit)
        elif measurement.status != "ok" and former is not None and former.unseen < HELD:
            self.skip()
            return measurement
        self._keep(prior)
        return measurement

    def _keep(self, prior: Prior | None) -> None:
        """Keep a frame's prior; after a gap without the memory of the frames before that."""
        if prior is not None and self._after_gap:
            prior = replace(prior, past=prior.past[-1:], slopes=prior.slopes[-1:])
        self._prior, self._after_gap = prior, False
