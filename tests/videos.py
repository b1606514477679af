"""Small videos: a pattern that moves, with sound."""

from fractions import Fraction

import numpy as np


def pattern(height, width, shift=0):
    """(H, W, 3) uint8 without edges, which encoders keep nearly as it is."""
    y, x = np.mgrid[:height, :width].astype(float)
    waves = [np.sin((x + 3 * shift) / 9), np.cos(y / 7 + 0.2 * shift), np.sin((x + y) / 11)]
    return np.stack([128 + 100 * wave for wave in waves], -1).astype(np.uint8)


def write_video(
    path,
    times,
    *,
    images=None,
    size=(64, 96),
    codec="mpeg4",
    pixels="yuv420p",
    tick=Fraction(1, 30),
    rotation=None,
    sound=None,
    words=None,
    matrix=None,
    full=None,
    **options,
):
    """Write a video with a frame at each of these multiples of `tick`, in seconds.

    It shows `images`, (H, W) uint8 each, or a pattern of `size`; `options` are the encoder's.
    `sound` is the encoder of a tone as long as the video, `words` a file of subtitles; `matrix` and `full` number what
    colours mean, as ffmpeg does; the video is to be shown with a `rotation`, in degrees.
    """
    import av

    shown = images or [pattern(*size, number) for number in range(len(times))]
    with av.open(str(path), "w") as file:
        stream = file.add_stream(codec, rate=30, time_base=tick, options=options)
        (stream.height, stream.width), stream.pix_fmt = shown[0].shape[:2], pixels
        stream.codec_context.qscale, stream.codec_context.global_quality = True, 2 * 118
        if matrix is not None:
            stream.codec_context.colorspace, stream.codec_context.color_range = matrix, full
        if rotation is not None:
            stream.set_display_rotation(rotation)
        if sound is not None:
            tone = file.add_stream(sound, rate=48000, layout="mono")
            tone.metadata["language"] = "fin"
        if words is not None:
            with av.open(words) as text:
                said = file.add_stream_from_template(text.streams[0])
                packets = [packet for packet in text.demux() if packet.dts is not None]
        for image, time in zip(shown, times, strict=True):
            form = "gray" if image.ndim == 2 else "rgb24"
            frame = av.VideoFrame.from_ndarray(image, format=form).reformat(format=pixels)
            frame.pts, frame.time_base = time, tick
            file.mux(stream.encode(frame))
        if sound is not None:
            count = tone.codec_context.frame_size or 1024
            for number in range(int((times[-1] + 1) * tick * 48000 / count)):
                wave = 0.2 * np.sin(0.05 * np.arange(number * count, (number + 1) * count))
                frame = av.AudioFrame.from_ndarray(wave[None].astype(np.float32), format="fltp", layout="mono")
                frame.sample_rate, frame.pts = 48000, number * count
                file.mux(tone.encode(frame))
            file.mux(tone.encode(None))
        file.mux(stream.encode(None))
        if words is not None:
            for packet in packets:
                packet.stream = said
                file.mux(packet)


def read_video(path):
    """Return what a video says of itself, in a dictionary."""
    import av

    with av.open(path) as file:
        stream = file.streams.video[0]
        frames = list(file.decode(stream))
        about = {
            "times": [float(frame.pts * frame.time_base) for frame in frames],
            "frames": frames,
            "rate": stream.average_rate,
            "rotation": frames[0].rotation,
            "matrix": (frames[0].colorspace, frames[0].color_range),
            "codec": stream.codec_context.name,
            "pixels": stream.codec_context.pix_fmt,
            "languages": [other.language for other in file.streams.audio],
        }
    with av.open(path) as file:
        others = [stream for stream in file.streams if stream.type in ("audio", "subtitle")]
        packets = [packet for packet in file.demux(others) if packet.dts is not None] if others else []
        about["packets"] = [(packet.stream.type, packet.pts * packet.time_base, bytes(packet)) for packet in packets]
    return about
