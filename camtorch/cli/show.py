"""The command `camtorch show`: a calibration in numbers and as an image."""

import argparse

import numpy as np

from camtorch.analysis.numbers import difference, summarise
from camtorch.cli import images, targets
from camtorch.cli.cameras import one, read_other, read_rig
from camtorch.plot.figures import require_matplotlib
from camtorch.viewer.viewer import write_viewer


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    path, output, against = arguments.input, arguments.output, arguments.against
    html, photograph = arguments.html, arguments.image
    if output is not None:
        targets.check(output, force=arguments.force, inputs=(path, against))
        images.check_kind(output)
        require_matplotlib()
    if html is not None:
        targets.check(html, force=arguments.force, inputs=(path, against, photograph))
    elif photograph is not None:
        raise ValueError("--html must be given with --image; got none")
    rig, other = read_rig(path, arguments.name, arguments.from_model, arguments.size), None
    if any(file is not None for file in (output, against, html)) and one(path, rig).image_size is None:
        raise ValueError(f"{path}: must have an image size; got none. Add --size WxH")
    cameras = {name: one(path, rig, name) for name in rig.cameras}
    ((name, camera), *_) = cameras.items()
    if against is not None:
        other = read_other(against, arguments.name, arguments.from_model)
        if other.image_size not in (None, camera.image_size):
            sizes = f"{other.width}x{other.height} and {camera.width}x{camera.height}"
            raise ValueError(f"{against} and {path} must be for the same size; got {sizes}")
    if html is not None:
        html.parent.mkdir(parents=True, exist_ok=True)
        write_viewer(camera, html, photograph)
    for name, camera in cameras.items():
        print(f"{path}: {name}", *summarise(camera).lines(), sep="\n")
    if other is not None:
        compared = difference(camera, other)
        line = f"against {against}: {compared}, over {100 * compared.part:.4g} % of the image"
        if compared.part and not compared.same:  # a few rays at the rim may dominate the rms
            median, close = compared.apart[compared.both].median(), compared.both & (compared.apart <= 1)
            line += f"; median {median:.3g} px, {100 * close.double().mean():.3g} % of the image within 1 px"
        print(line)
    if output is not None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        from camtorch import plot

        title = f"{path.name}: {name if name != 'camera' else camera.key}, {camera.width} x {camera.height}"
        canvas = FigureCanvasAgg(plot.portrait(camera, other, title=title))
        canvas.draw()
        images.write(output, np.array(canvas.buffer_rgba())[..., :3])
        print(f"{output}: distortion, radius over angle{', difference' if other is not None else ''}")
    if html is not None:
        print(f"{html}: the lens, live, to be opened in a browser")
