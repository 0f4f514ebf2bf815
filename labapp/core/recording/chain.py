"""Measurement of consecutive frames: each with the prior of the previous frame, or else without.

The same frames give the same results: nothing depends on the clock or on the number of processes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace

from labapp.core.geometry.bench import Bench
from labapp.core.images.band_pass import quick_dots
from labapp.core.images.dots import Dots, Image
from labapp.core.pipeline import Measurement, Settings, measure
from labapp.core.sequence.prior import Prior
from labapp.core.sequence.tracking import HELD
from labapp.core.values import CannotMeasure


class WarmChain:
    """Measures the frames of one recording in their order.

    Parameters
    ----------
    settings
        Settings of the measurement. Only the fit to band-passed dots, the default, can be tracked.
    on_step
        See `pipeline.measure`; called for tracked frames.

    Attributes
    ----------
    track_lost
        Why the last frame was measured without a prior; None if it was tracked.
    """

    def __init__(
        self, bench: Bench, settings: Settings, on_step: Callable[[str], None] = lambda _: None
    ) -> None:
        self.bench, self.settings = bench, settings
        self._on_step = on_step
        self.track_lost: str | None = None
        self._prior: Prior | None = None
        self._after_gap = False
        self._ahead: list[tuple[Image, Dots]] = []

    def look_ahead(self, images: Iterable[Image]) -> None:
        """Find the dots of some following frames at once, if they will be tracked.

        This takes less time than frame by frame, as the code and data of the tracking would replace
        those of the detector in the processor's caches. The results are the same.
        """
        self._ahead = []
        if self._prior is not None:
            tuning, settings = self._prior.tuning, self.settings.dots.band_pass
            for image in images:
                with suppress(CannotMeasure, ValueError):  # of that frame, when it is measured
                    self._ahead.append((image, quick_dots(image, tuning, settings)))

    def skip(self) -> None:
        """Skip a frame, after which frames are no longer equally spaced in time.

        The next frame is predicted from the last one, without extrapolation of the oscillation.
        """
        if self._prior is not None:
            self._prior, self._after_gap = self._prior.after_gap(), True

    def track(self, image: Image) -> Measurement | None:
        """Measure the next frame with the prior; None if the track is lost.

        No search is started, and a later frame may be tracked again.
        """
        if self._prior is None:
            self.track_lost = "no earlier frame was measured"
            return None
        dots = next((dots for known, dots in self._ahead if known is image), None)
        measurement, prior = measure(
            image, self.bench, self.settings, self._prior, on_step=self._on_step, dots=dots
        )
        if prior is None:
            self.track_lost = measurement.reason
            return None
        self._keep(prior)
        self.track_lost = None
        return measurement

    def measure(self, image: Image) -> Measurement:
        """Measure the next frame with the prior, or else without one (`search`)."""
        return self.track(image) or self.search(image)

    def search(self, image: Image) -> Measurement:
        """Measure the next frame as if it were the first; later frames may be tracked from it."""
        self.track_lost = self.track_lost or "it was measured by itself"
        measurement, prior = measure(image, self.bench, self.settings)
        former = self._prior
        if prior is not None and former is not None:
            prior = prior.with_past_of(former, self.bench)
        elif measurement.status != "ok" and former is not None and former.unseen < HELD:
            self.skip()
            return measurement
        self._keep(prior)
        return measurement

    def _keep(self, prior: Prior | None) -> None:
        """Store a frame's prior; after a gap without the surfaces of the frames before the gap."""
        if prior is not None and self._after_gap:
            prior = replace(prior, past=prior.past[-1:], slopes=prior.slopes[-1:])
        if prior is None or self._prior is None or prior.tuning is not self._prior.tuning:
            self._ahead = []
        self._prior, self._after_gap = prior, False
