"""The camera's picture on the recording page, rings around its dots, and the assessment below."""

from __future__ import annotations

from labapp.core.images.exposure import Exposure
from labapp.core.quality import Quality
from labapp.core.values import FloatArray
from labapp.gui.live.live import Live
from labapp.gui.views.picture import PictureView, rings
from labapp.gui.widgets.exposure import ExposureBars


class LivePicture:
    """Shows frames of a camera in the page's picture, which is used without a camera, too."""

    def __init__(self, picture: PictureView, exposure: ExposureBars) -> None:
        self._picture, self._exposure = picture, exposure
        self.rings = rings()
        self.rings.hide()
        picture.add(self.rings)

    @property
    def frame_byte(self) -> int | None:
        """Size of the shown frame in memory; None if there is none."""
        picture = self._picture.picture
        return None if picture is None else picture.nbytes

    def begin(self) -> None:
        """Show rings from the next frame on."""
        self.rings.setData([])
        self.rings.show()

    def end(self) -> None:
        """Hide the rings."""
        self.rings.hide()

    def follow(self, live: Live, is_measured: bool) -> bool:
        """Show the newest frame and assessment; returns whether a frame was shown.

        Frames that are measured are assessed better by that: see `show_quality`.
        """
        shown = live.newest()
        is_shown = shown is not None and self._picture.isVisible()
        if shown is not None and is_shown:
            self._picture.show_picture(shown.frame.image)
            self._ring_dots(shown.dots_px)
        looked = live.looked()
        if looked is not None:
            self._ring_dots(looked.dots_px)
            if isinstance(looked.quality, Exposure):
                self._exposure.show_lines(looked.quality)
                self._exposure.show()
            elif not is_measured:
                self.show_quality(looked.quality)
        return is_shown

    def show_quality(self, quality: Quality) -> None:
        """Show the assessment of a frame."""
        self._exposure.show_exposure(quality.exposure, quality.words, quality.grade == "good")
        self._exposure.show()

    def _ring_dots(self, dots_px: FloatArray | None) -> None:
        if dots_px is not None:
            self.rings.setData(pos=dots_px)
