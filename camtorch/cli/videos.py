"""Video files through warps, by PyAV: time stamps, sound, subtitles and colours stay as they are."""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch

from camtorch.camera import Camera
from camtorch.io.writing import replacing
from camtorch.jobs.items import Item, Listener
from camtorch.warp.warp import Warp

FORMATS = {
    ".avi": "avi",
    ".m4v": "mp4",
    ".mkv": "matroska",
    ".mov": "mov",
    ".mp4": "mp4",
    ".mts": "mpegts",
    ".ts": "mpegts",
    ".webm": "webm",
}
"""What ffmpeg calls the formats of files with these suffixes, in lower case."""
_READ = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts"  # no playlists, which would have other files read
_QUALITIES = {"libx264": 18, "libx265": 20, "libvpx-vp9": 24, "libsvtav1": 24, "libaom-av1": 24}
_QUANTISER = 3  # of encoders without a crf: near the best
_LAMBDA = 118  # FF_QP2LAMBDA
_THREADS = 4  # of an encoder: what it makes depends on their number, and shall not depend on the machine's
_AHEAD = 8  # frames
_OFTEN = 0.1  # seconds between two reports
# how x264 weighs blocks by what refers to them is not the same each time; x265 says much
_OPTIONS = {"libx264": {"mbtree": "0"}, "libx265": {"x265-params": "log-level=error"}}
_EVEN = ("libx264", "libx265")
_BY_QUANTISER = ("mpeg4", "mpeg2video", "mjpeg")
_CUT = 0.5  # seconds that may be missing at the end


class VideoFileError(ValueError):
    """A video that cannot be read or written. The text names the file and the reason."""


def is_video(path: Path) -> bool:
    """Whether its name says so."""
    return path.suffix.lower() in FORMATS


def check_kind(path: Path) -> None:
    """Refuse, by a VideoFileError, a name that says of no format that videos can be written as."""
    if not is_video(path):
        what = path.suffix or "no suffix"
        raise VideoFileError(f"{path}: {what}: no video can be written as that; try {', '.join(FORMATS)}")


@dataclass(frozen=True)
class Encoder:
    """What videos are written with."""

    codec: str | None = None
    """An encoder of ffmpeg's; by default what suits the format."""
    crf: int | None = None
    """Its quality; by default one at which hardly anything is lost."""

    def check(self) -> None:
        """Refuse what no video can be written with, and a PyAV that is not installed."""
        av = _av()
        if self.codec is None:
            return
        try:
            kind = av.Codec(self.codec, "w").type
        except av.codec.codec.UnknownCodecError:
            known = ", ".join(_QUALITIES)
            raise ValueError(
                f"--codec {self.codec}: there is no such encoder; there are {known}, ffv1 and others"
            ) from None
        if kind != "video":
            raise ValueError(f"--codec {self.codec}: an encoder of {kind}, not of video")
        if self.crf is not None and not _has_crf(self.codec):
            raise ValueError(f"--crf: {self.codec} has no such option")


def _av() -> Any:
    try:
        return importlib.import_module("av")
    except ImportError:
        raise ImportError("videos take PyAV, which is not installed: pip install 'camtorch[video]'") from None


def _has_crf(codec: str) -> bool:
    return any(option.name == "crf" for option in _av().CodecContext.create(codec, "w").supported_options.private)


# -- what a file says of itself


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """A file and its first video stream; what goes wrong with it in the block is a VideoFileError."""
    av = _av()
    try:
        with av.open(os.fspath(path), options={"format_whitelist": _READ}) as container:
            if not container.streams.video:
                raise VideoFileError(f"{path}: no video is in it")
            yield container, container.streams.video[0]
    except av.error.FFmpegError as error:
        raise VideoFileError(f"{path}: {error.strerror}") from None


def size_of(path: Path) -> tuple[int, int] | None:
    """(height, width) of a video; None of anything else."""
    try:
        with _opened(path) as (_, stream):
            return stream.codec_context.height, stream.codec_context.width
    except VideoFileError:
        return None


def length_of(path: Path) -> float:
    """Seconds; 0 where that is not said."""
    with _opened(path) as (container, stream):
        return float(_length(container, stream))


def frames(path: Path) -> Iterator[tuple[float, float, Any]]:
    """Frames as they are stored: when each is shown, in seconds, the part of the video until then, and PyAV's frame."""
    with _opened(path) as (container, stream):
        stream.thread_type = "AUTO"
        length, step = float(_length(container, stream)), float(1 / _rate(stream))
        start = None
        for number, (frame, _) in enumerate(_decoded(container, stream)):
            seconds = number * step if frame.time is None else float(frame.time)
            start = seconds if start is None else start
            yield seconds, min((seconds - start) / length, 1.0) if length else 0.0, frame


def _decoded(container: Any, stream: Any, *others: Any) -> Iterator[tuple[Any, Any]]:
    """(frame, None) of a stream, and (None, packet) of others, in the order in which they are stored."""
    has_begun = False
    for packet in container.demux(stream, *others):
        if packet.stream is not stream:
            if packet.dts is not None:
                yield None, packet
            continue
        try:
            decoded = packet.decode()
        except _av().error.InvalidDataError:
            if has_begun:
                raise
            continue  # a recording that begins between whole frames
        for frame in decoded:
            has_begun = True
            yield frame, None


def sized(item: Item) -> Item:
    """The item with the number of its frames, about, if it is a video that says how long it is."""
    if not is_video(item.inputs[0]):
        return item
    try:
        with _opened(item.inputs[0]) as (container, stream):
            return replace(item, size=max(int(stream.frames or _length(container, stream) * _rate(stream)), 1))
    except VideoFileError:
        return item


def _rate(stream: Any) -> Fraction:
    return stream.guessed_rate or stream.average_rate or Fraction(25)


def _length(container: Any, stream: Any) -> Fraction:
    """Seconds; 0 where that is not said."""
    if stream.duration is not None and stream.time_base is not None:
        duration: Fraction = stream.duration * stream.time_base
        return duration
    end, start = container.duration or 0, container.start_time or 0  # microseconds
    if "matroska" in container.format.name and start < end:  # others say how long it is
        end -= start
    return Fraction(end, 1_000_000)


# -- planes
#
# A video is stored in planes of brightness and colour, the latter often of half the resolution. Each goes through a
# warp of its own, so nothing is converted: it is half the work of RGB, and the colours that do not move stay exactly
# as they are.

_PLANAR = re.compile(r"(yuv[aj]?4\d\dp|gray|gbra?p)(9|10|12|14|16)?(le)?|nv12|nv16|nv24")


def _plane(frame: Any, index: int) -> np.ndarray[Any, Any]:
    """(H, W, C), the memory of a plane of a frame."""
    own = [component for component in frame.format.components if component.plane == index]
    plane, height, width = frame.planes[index], own[0].height, own[0].width
    values = np.frombuffer(plane, np.uint8 if own[0].bits <= 8 else np.uint16)
    row = plane.line_size // values.itemsize
    return values[: height * row].reshape(height, row)[:, : width * len(own)].reshape(height, width, len(own))


def _black(frame: Any, index: int) -> int:
    """The value of what shows nothing."""
    first = next(component for component in frame.format.components if component.plane == index)
    is_yuv = frame.format.name.startswith(("yuv", "nv"))
    # PyAV's is_chroma is False for chroma of the full resolution
    if is_yuv and first.index in (1, 2):
        return int(1 << (first.bits - 1))
    return 0 if _is_full(frame) or first.is_alpha or not is_yuv else int(16 << (first.bits - 8))


def _is_full(frame: Any) -> bool:
    """Whether its values go from 0 to the greatest, as those of images do."""
    return bool(frame.color_range == 2 or frame.format.name.startswith("yuvj"))


def _camera_of_plane(camera: Camera, size: tuple[int, int], left: bool) -> Camera:
    """The camera of a plane of a (height, width), that of its image's or half of it, rounded up.

    `left` says whether planes of half the width have their pixels where the left ones of the image's pairs are, as in
    MPEG-2 and what came after, rather than between.
    """
    height, width = size
    down, across = -(-camera.height // height), -(-camera.width // width)
    if (down, across) == (1, 1):
        return camera
    bottom, right = down * height - camera.height, across * width - camera.width
    camera = camera.pad(0, right, 0, bottom).resize(height, width)
    shift = camera.intrinsics.new_tensor([0.0, 0.0, 0.25 if left and across == 2 else 0.0, 0.0])
    return camera.replace(intrinsics=camera.intrinsics.detach() + shift)


class _Frames:
    """Warps frames of one size.

    Args:
        warp: of images.
        frame: as all are.
    """

    def __init__(self, warp: Warp, frame: Any):
        self.size, self._format = (warp.target.height, warp.target.width), frame.format.name
        left, new, self._warps = not self._format.startswith("yuvj"), self._new(), list[Warp]()
        for index in range(len(frame.planes)):
            sizes = (_plane(one, index).shape[:2] for one in (frame, new))
            before, after = (
                _camera_of_plane(camera, (height, width), left)
                for camera, (height, width) in zip((warp.source, warp.target), sizes, strict=True)
            )
            fill = float(_black(frame, index))
            of_plane = Warp(before, after, warp.rotation, fill=fill, tolerance=warp.tolerance)
            self._warps.append(of_plane.requires_grad_(False))

    def _new(self) -> Any:
        return _av().VideoFrame(self.size[1], self.size[0], self._format)

    def __call__(self, frame: Any) -> Any:
        """The new frame, at the same time."""
        new = self._new()
        for index, warp in enumerate(self._warps):
            values = torch.from_numpy(_plane(frame, index)).permute(2, 0, 1)[None]
            with torch.no_grad():
                _plane(new, index)[:] = warp(values)[0].permute(1, 2, 0).numpy()
        _copy(frame, new, "pts", "time_base", "duration", *_COLOURS)
        return new


_COLOURS = ("color_range", "colorspace", "color_primaries", "color_trc")
"""What the colours of a frame mean."""


def _copy(one: Any, other: Any, *names: str) -> None:
    for name in names:
        setattr(other, name, getattr(one, name))


# -- from file to file


def remake(
    source: Path,
    target: Path,
    warp_of: Callable[[tuple[int, int]], tuple[Warp, dict[str, Any]]],
    encoder: Encoder,
    listener: Listener,
) -> dict[str, Any]:
    """Write a video whose frames are those of another one through a warp.

    Time stamps, sound, subtitles, titles, the rotation with which it is shown, and what colours mean are
    those of the source. Pixels are square then. What the format of the target cannot hold is an error.

    Args:
        source: a video.
        target: a new one, whose suffix says the format. It is written whole or not at all; folders that lack are made.
        warp_of: the warp for frames of a (height, width), and what is to be known of it.
        encoder: of the new video.
        listener: is told how many frames are done.

    Returns:
        What is to be known of the warp, and "frames", how many there are.

    Raises:
        VideoFileError: what is not a video, ends too early, changes its size, or cannot be written so.
    """
    av = _av()
    with _opened(source) as (container, stream):
        first, _ = next(_decoded(container, stream), (None, None))
        if first is None:
            raise VideoFileError(f"{source}: no frame of it can be read")
    warp, facts = warp_of((first.height, first.width))
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as (file,), _opened(source) as (container, stream):
        # exact: no random identifiers
        output = av.open(file, "w", format=FORMATS[target.suffix.lower()], options={"fflags": "+bitexact"})
        try:
            new = _Remake(source, target, container, stream, output, encoder, first, listener)
            count = new.run(_Frames(warp, new.first))
        except BaseException:
            with contextlib.suppress(av.error.FFmpegError):
                output.close()
            raise
        output.close()
    return facts | {"frames": count}


@dataclass
class _Remake:
    """A video on its way from file to file."""

    source: Path
    target: Path
    container: Any
    stream: Any
    output: Any
    encoder: Encoder
    first: Any
    """Frame."""
    listener: Listener
    _first_stamp: int | None = None
    _stamp: int | None = None
    """Of the last frame."""

    def __post_init__(self) -> None:
        streams, first, format = self.container.streams, self.first, self.output.format.name
        self.codec = self.encoder.codec or ("libvpx-vp9" if format == "webm" else "libx264")
        self.others = [other for other in streams if other.type in ("audio", "subtitle")]
        self.rate, self.size = _rate(self.stream), (first.height, first.width)
        self.pixels = _pixels(first.format.name, self.codec)
        if first.interlaced_frame:
            self.listener.note(f"{self.source}: is interlaced; two moments get mixed within its frames")
        if lost := sorted({one.type for one in streams if one not in (self.stream, *self.others)}):
            self.listener.note(f"{self.source}: its other streams, {', '.join(lost)}, are left out")
        # formats and encoders that know no time stamps but multiples of one step
        whole = format == "avi" or self.codec == "mpeg4"
        self.tick = 1 / self.rate if whole else first.time_base or 1 / self.rate
        self.first = _converted(first, self.pixels)

    def run(self, frames: _Frames) -> int:
        """How many frames were written."""
        stream, copies = self._new_stream(frames.size), self._copied_streams()
        self.stream.thread_type = "AUTO"
        begin = float((self.container.start_time or 0) / 1e6)
        count, end, last, shown = 0, 0.0, 0.0, time.monotonic()
        # the encoder works in a thread of its own, the decoder in those of ffmpeg
        with ThreadPoolExecutor(1) as writer:
            at_work: deque[Future[None]] = deque()
            for frame, packet in _decoded(self.container, self.stream, *self.others):
                if packet is not None:
                    last = max(last, float((packet.pts or packet.dts) * packet.time_base) - begin)
                    packet.stream = copies[packet.stream.index]
                    at_work.append(writer.submit(self.output.mux, packet))
                else:
                    if self.size != (frame.height, frame.width):
                        was, now = f"{self.size[1]}x{self.size[0]}", f"{frame.width}x{frame.height}"
                        raise VideoFileError(f"{self.source}: its frames are {was}, then {now}")
                    self._date(frame)
                    end = float(frame.pts * frame.time_base + 1 / self.rate) - begin
                    count += 1
                    at_work.append(writer.submit(self._encode, stream, frames(_converted(frame, self.pixels))))
                if len(at_work) > _AHEAD:
                    at_work.popleft().result()
                if time.monotonic() > shown + _OFTEN:
                    shown = time.monotonic()
                    self.listener.done(count)
            at_work.append(writer.submit(self._encode, stream, None))
            for future in at_work:
                future.result()
        length = float(_length(self.container, self.stream))
        end = end if self.stream.duration is not None else max(end, last)
        if length - end > max(_CUT, 0.02 * length):
            raise VideoFileError(
                f"{self.source}: ends after {end:.1f} of {length:.1f} seconds; it is cut off or damaged"
            )
        return count

    def _date(self, frame: Any) -> None:
        """Have a frame's time stamp, where there is none, or a wrong one, follow the last one's."""
        frame.time_base = frame.time_base or 1 / self.rate
        stamp = frame.pts
        if self.container.format.name == "avi":  # whose stamps are those of the order in which frames are stored
            self._first_stamp = frame.dts if self._first_stamp is None else self._first_stamp
            stamp = None if frame.dts is None or self._first_stamp is None else frame.dts - self._first_stamp
        if stamp is None:
            stamp = 0 if self._stamp is None else self._stamp + round(1 / self.rate / frame.time_base)
        frame.pts = self._stamp = stamp if self._stamp is None else max(stamp, self._stamp + 1)

    def _encode(self, stream: Any, frame: Any) -> None:
        """Write a frame; None in the end."""
        if frame is not None and frame.time_base != self.tick:
            frame.pts, frame.time_base = round(frame.pts * frame.time_base / self.tick), self.tick
            frame.duration = 1
        self.output.mux(stream.encode(frame))

    def _new_stream(self, size: tuple[int, int]) -> Any:
        """Of frames of a (height, width) that are as the first one, but for that."""
        frame, format, (height, width) = self.first, self.output.format.name, size
        try:
            stream = self.output.add_stream(self.codec, rate=self.rate, time_base=self.tick)
        except ValueError as error:
            raise VideoFileError(f"{self.target}: {error}; --codec names another encoder") from None
        halved = {(c.width < frame.width, c.height < frame.height) for c in frame.format.components if c.is_chroma}
        if self.codec in _EVEN and any((across and width % 2) or (down and height % 2) for across, down in halved):
            raise VideoFileError(
                f"{self.target}: {width}x{height}, but {self.codec} wants even numbers; --size names them"
            )
        stream.width, stream.height, stream.pix_fmt = width, height, frame.format.name
        context = stream.codec_context
        _copy(frame, context, *_COLOURS)
        context.thread_count = _THREADS
        if _has_crf(self.codec):
            crf = _QUALITIES.get(self.codec, 20) if self.encoder.crf is None else self.encoder.crf
            stream.options = {"crf": str(crf), **_OPTIONS.get(self.codec, {})}
        elif self.codec in _BY_QUANTISER:
            context.qscale, context.global_quality = True, _QUANTISER * _LAMBDA
        if format == "avi":
            stream.options |= {"bf": "0"}  # its frames come in the order in which they are shown
        matrix = frame.side_data.get("DISPLAYMATRIX")
        if matrix is not None:
            stream.set_display_matrix(np.frombuffer(matrix, np.int32).tolist())
            if format not in ("mp4", "mov", "matroska"):
                self.listener.note(f"{self.source}: is shown turned, which {self.target.suffix} files do not say")
        stream.metadata.update(_kept(self.stream.metadata))
        self.output.metadata.update(_kept(self.container.metadata))
        return stream

    def _copied_streams(self) -> dict[int, Any]:
        """The new streams of sound and subtitles, by the indices of the old ones."""
        copies = {}
        for other in self.others:
            try:
                copies[other.index] = copy = self.output.add_stream_from_template(other)
            except ValueError:
                raise VideoFileError(
                    f"{self.source}: its {other.type}, {other.codec_context.name}, cannot be kept in "
                    f"{self.target.suffix}; .mkv takes nearly all"
                ) from None
            copy.metadata.update(_kept(other.metadata))
            copy.disposition = other.disposition
        return copies


def _pixels(format: str, codec: str) -> str:
    """The format of pixels to work in: that of the video, if that can be done and written."""
    known = [one.name for one in _av().Codec(codec, "w").video_formats or ()]
    if _PLANAR.fullmatch(format) and (format in known or not known):
        return format
    return "yuv420p" if "yuv420p" in known or not known else next(filter(_PLANAR.fullmatch, known), known[0])


def _converted(frame: Any, format: str) -> Any:
    if frame.format.name.startswith("gray") and not frame.color_range:
        frame.color_range = 2  # as ffmpeg takes it, but not what reads it as brightness without colours
    if frame.format.name == format:
        return frame
    # of RGB nothing else is known, and this is what players take for granted; all else keeps its range
    is_full = _is_full(frame) and not frame.format.is_rgb
    options = {"dst_colorspace": "ITU709"} if frame.format.is_rgb else {}
    new = frame.reformat(format=format, dst_color_range="JPEG" if is_full else "MPEG", **options)
    new.colorspace, new.color_range = 1 if frame.format.is_rgb else frame.colorspace, 2 if is_full else 1
    return new


def _kept(metadata: dict[str, str]) -> dict[str, str]:
    """What the new file does not say of itself."""
    own = ("brand", "minor_version", "encoder", "DURATION", "BPS", "NUMBER_OF", "_STATISTICS")
    return {name: text for name, text in metadata.items() if not any(word in name for word in own)}
