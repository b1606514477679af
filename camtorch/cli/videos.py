"""Videos through warps, by PyAV: time stamps, sound and subtitles are kept."""

import contextlib
import os
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch

from camtorch.cameras.camera import Camera
from camtorch.io.writing import replacing
from camtorch.values.arguments import imported
from camtorch.warp.warp import Warp

WRITTEN = {".mp4": "mp4", ".m4v": "mp4", ".mov": "mov", ".mkv": "matroska", ".webm": "webm"}  # ffmpeg's names
FORMATS = frozenset({*WRITTEN, ".avi", ".mts", ".ts"})  # suffixes of files that are read
# encoders with their options; x264's weights of blocks (mbtree) are not reproducible
_CODECS = {"libx264": {"crf": "18", "mbtree": "0"}, "libvpx-vp9": {"crf": "24", "b": "0"}, "ffv1": dict[str, str]()}
_READ = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts"  # no playlists, which could read other files
_THREADS = 4  # of an encoder: its output depends on their number, so fixed for all machines
_COLOURS = ("color_range", "colorspace", "color_primaries", "color_trc")  # colour attributes of a frame


def is_video(path: Path) -> bool:
    """Whether a path has the suffix of a video."""
    return path.suffix.lower() in FORMATS


def written_suffix(path: Path) -> str:
    """Return the suffix of the video that is made from another one."""
    return path.suffix if path.suffix.lower() in WRITTEN else ".mkv"


def require() -> Any:
    """Return PyAV, or raise an ImportError with the line to install it."""
    return imported("av", "videos need PyAV", "video")


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """Open a file, and yield it and its first video stream; errors of ffmpeg in the block are raised as ValueError."""
    av = require()
    try:
        with av.open(os.fspath(path), options={"format_whitelist": _READ}) as container:
            if not container.streams.video:
                raise ValueError(f"{path}: must have a video stream; got none")
            container.streams.video[0].thread_type = "AUTO"
            yield container, container.streams.video[0]
    except av.error.FFmpegError as error:
        raise ValueError(f"{path}: {error.strerror}") from None


def size_of(path: Path) -> tuple[int, int] | None:
    """Return (height, width) of a video; None for any other file."""
    with contextlib.suppress(ValueError), _opened(path) as (_, stream):
        return stream.codec_context.height, stream.codec_context.width
    return None


def count_of(path: Path) -> int | None:
    """Return the approximate number of frames; None if the file has no length."""
    with _opened(path) as (container, stream):
        return stream.frames or round(_span(container)[1] * _rate(stream)) or None


def frames(path: Path) -> Iterator[tuple[float, Any]]:
    """Yield PyAV's frames as they are stored, each with its time in seconds after the first frame."""
    with _opened(path) as (container, stream):
        start = None
        for frame, _ in _decoded(container, stream):
            start = frame.time if start is None else start
            yield frame.time - start, frame


def _span(container: Any) -> tuple[float, float]:
    """Return the start time and the length of a file in seconds; 0 if the file does not state them."""
    begin, length = ((value or 0) / 1e6 for value in (container.start_time, container.duration))
    # Matroska states the end instead
    return begin, max(length - begin, 0.0) if "matroska" in container.format.name else length


def _rate(stream: Any) -> Fraction:
    return stream.guessed_rate or stream.average_rate or Fraction(25)


def _decoded(container: Any, stream: Any, *others: Any) -> Iterator[tuple[Any, Any]]:
    """Yield (frame, None) of a stream with increasing time stamps, and (None, packet) of others as stored."""
    last, count, step = None, 0, 1 / _rate(stream)
    for packet in container.demux(stream, *others):
        if packet.stream is not stream:
            if packet.dts is not None:
                yield None, packet
            continue
        try:
            decoded = packet.decode()
        except require().error.InvalidDataError:
            if last is not None:
                raise
            continue  # the recording begins between key frames
        for frame in decoded:
            frame.time_base = frame.time_base or step
            if container.format.name == "avi":  # AVI's stamps are in storage order
                frame.pts = round(count * step / frame.time_base)
            elif frame.pts is None:
                frame.pts = 0 if last is None else last + round(step / frame.time_base)
            last = frame.pts = frame.pts if last is None else max(frame.pts, last + 1)
            count += 1
            yield frame, None


@torch.no_grad()
def remake(
    source: Path,
    target: Path,
    warp_of: Callable[[tuple[int, int]], Warp],
    codec: str | None = None,
    crf: int | None = None,
    done: Callable[[], object] = lambda: None,
) -> tuple[tuple[int, int], int]:
    """Write a video of warped frames as a whole or not at all; return (height, width) of the old ones and their number.

    Frames are warped in YUV of eight bits in 4:2:0, as nearly all are stored, which is half the work of RGB.
    `warp_of` returns the warp for frames of a (height, width); `done` is called after each frame.
    """
    av = require()
    with _opened(source) as (container, stream):
        first = next((frame for frame, _ in _decoded(container, stream)), None)
    if first is None:
        raise ValueError(f"{source}: must have a readable frame; got none")
    warp = warp_of((first.height, first.width))
    black = 0.0 if first.reformat(format="yuv420p").color_range == 2 else 16.0

    def still(source: Camera, target: Camera, fill: float) -> Warp:
        return Warp(source, target, warp.rotation, fill=fill, tolerance=warp.tolerance).requires_grad_(False)

    colour = still(_halved(warp.source), _halved(warp.target), 128.0)
    warps = still(warp.source, warp.target, black), colour, colour
    count, end = 0, 0.0
    target.parent.mkdir(parents=True, exist_ok=True)
    # bitexact: no random identifiers
    options = {"format": WRITTEN[target.suffix.lower()], "options": {"fflags": "+bitexact"}}
    with replacing(target) as (file,), _opened(source) as (container, stream), av.open(file, "w", **options) as output:
        new = _new_stream(output, first, _rate(stream), codec, crf, target, warp.target)
        others = [other for other in container.streams if other.type in ("audio", "subtitle")]
        copies = {other.index: _copied_stream(output, other, source, target) for other in others}
        begin, length = _span(container)
        for frame, packet in _decoded(container, stream, *others):
            if packet is not None:
                end = max(end, float((packet.pts or packet.dts) * packet.time_base) - begin)
                packet.stream = copies[packet.stream.index]
                output.mux(packet)
                continue
            end = max(end, frame.time + float(1 / _rate(stream)) - begin)
            old, made = frame.reformat(format="yuv420p"), av.VideoFrame(new.width, new.height, "yuv420p")
            for plane, pixels, target_pixels in zip(warps, _planes(old), _planes(made), strict=True):
                target_pixels[:] = plane(torch.from_numpy(pixels)[None, None])[0, 0].numpy()
            for name in ("pts", "time_base", "duration", *_COLOURS):
                setattr(made, name, getattr(old, name))
            output.mux(new.encode(made))
            count += 1
            done()
        output.mux(new.encode(None))
        if length - end > max(0.5, 0.02 * length):  # seconds that may be missing
            raise ValueError(f"{source}: must last {length:.1f} seconds; got {end:.1f}. It is cut off or damaged")
    return (first.height, first.width), count


def _planes(frame: Any) -> list[np.ndarray[Any, Any]]:
    """Return the planes (H, W) of a frame, brightness and two colours at half the resolution; they share its memory."""
    return [np.frombuffer(p, np.uint8).reshape(-1, p.line_size)[: p.height, : p.width] for p in frame.planes]


def _halved(camera: Camera) -> Camera:
    """Return the camera of the colours, whose pixels lie at the left pixels of the image's pairs, as in MPEG-2."""
    height, width = (camera.height + 1) // 2, (camera.width + 1) // 2
    camera = camera.pad(0, 2 * width - camera.width, 0, 2 * height - camera.height).resize(height, width)
    shift = camera.intrinsics.new_tensor([0.0, 0.0, 0.25, 0.0])
    return camera.replace(intrinsics=camera.intrinsics.detach() + shift)


def _new_stream(
    output: Any, first: Any, rate: Fraction, codec: str | None, crf: int | None, target: Path, camera: Camera
) -> Any:
    codec = codec or ("libvpx-vp9" if output.format.name == "webm" else "libx264")
    if codec == "libx264" and (camera.width % 2 or camera.height % 2):
        size = f"{camera.width}x{camera.height}"
        raise ValueError(f"{target}: size must be even for {codec}; got {size}. Set it with --size")
    try:
        stream = output.add_stream(codec, rate=rate, time_base=first.time_base)
    except ValueError as error:
        raise ValueError(f"{target}: {error}. Choose another encoder with --codec") from None
    stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "yuv420p"
    like = first.reformat(format="yuv420p")
    for name in _COLOURS:
        setattr(stream.codec_context, name, getattr(like, name))
    stream.codec_context.thread_count = _THREADS
    stream.options = _CODECS[codec] | ({} if crf is None else {"crf": str(crf)})
    if matrix := first.side_data.get("DISPLAYMATRIX"):
        stream.set_display_matrix(np.frombuffer(matrix, np.int32).tolist())
    return stream


def _copied_stream(output: Any, other: Any, source: Path, target: Path) -> Any:
    try:
        copy = output.add_stream_from_template(other)
    except ValueError:
        kind = f"{other.type}, {other.codec_context.name}"
        raise ValueError(f"{source}: streams must fit in {target.suffix}; got {kind}. .mkv takes nearly all") from None
    copy.metadata.update((key, value) for key, value in other.metadata.items() if key == "language")
    return copy
