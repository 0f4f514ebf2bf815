"""Measurement of consecutive frames: each with the prior of the previous frame, or else without.

The same frames give the same results: nothing depends on the clock or on the number of processes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from labapp.core.geometry.bench import Bench
from labapp.core.images.dots import Image
from labapp.core.pipeline import Measurement, Settings, measure
from labapp.core.sequence.prior import Prior
from labapp.core.sequence.tracking import HELD


class WarmChain:
    """Measures the frames of one recording in their order.

    Parameters
    ----------
    bench
        The bench.
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
        measurement, prior = measure(
            image, self.bench, self.settings, self._prior, on_step=self._on_step
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
            prior = prior.with_past_of(former, self.bench, self.settings.fit)
        elif measurement.status != "ok" and former is not None and former.unseen < HELD:
            self.skip()
            return measurement
        self._keep(prior)
        return measurement

    def _keep(self, prior: Prior | None) -> None:
        """Store a frame's prior; after a gap without the surfaces of the frames before the gap."""
        if prior is not None and self._after_gap:
            prior = replace(prior, past=prior.past[-1:], slopes=prior.slopes[-1:])
        self._prior, self._after_gap = prior, False
