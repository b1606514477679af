"""The view of a camera in notebooks: its numbers, and a small image of its angles."""

import html
import math

import torch

from camtorch.projection.camera_like import CameraLike

_WIDTH = 260  # px of the image
_CELLS = 48  # along the wider side of the lattice that finds pixels without rays
_CIRCLE_POINTS = 96
_ENOUGH_CIRCLES = 7


@torch.no_grad()
def as_html(camera: CameraLike) -> str:
    """Return `repr` as HTML, and for a single camera with image_size circles of equal angle, grey where it is blind."""
    text = f'<pre style="margin: 0">{html.escape(repr(camera))}</pre>'
    if camera.is_mixed or camera.batch_shape or camera.image_size is None:
        return text
    height, width = camera.image_size
    side = max(height, width) / _CELLS
    rows, columns = math.ceil(height / side), math.ceil(width / side)
    down, across = (torch.arange(count, dtype=torch.float64) for count in (rows, columns))
    middles = torch.stack(torch.meshgrid(across, down, indexing="xy"), -1) * side + (side - 1) / 2
    rays, seen = (part.cpu() for part in camera.unproject(middles.to(camera.intrinsics.device)))
    cell = f"h{side:.1f}v{side:.1f}h-{side:.1f}z"
    blind = "".join(f"M{i * side:.1f} {j * side:.1f}{cell}" for j, i in (~seen).nonzero().tolist())
    shapes = [f'<path d="{blind}" fill="#8888" stroke="none"/>']
    most = math.degrees(float(rays[..., 2][seen].clamp(-1, 1).acos().max())) if bool(seen.any()) else 0.0
    step = next((s for s in (1, 2, 5, 10, 15) if most / s < _ENOUGH_CIRCLES), 30)
    turn = torch.linspace(0, 2 * math.pi, _CIRCLE_POINTS + 1, dtype=torch.float64)
    for angle in range(step, int(most) + 1, step):
        theta = torch.full_like(turn, math.radians(angle))
        circle = torch.stack((theta.sin() * turn.cos(), theta.sin() * turn.sin(), theta.cos()), -1)
        pixels, valid = (part.cpu() for part in camera.project(circle.to(camera.intrinsics.device)))
        # a new piece begins after a point that is not seen, and at the seam of a panorama
        jumps = pixels.diff(dim=0).abs().amax(-1, keepdim=True)[:, 0] > max(height, width) / 4
        joined = [False, *(valid[1:] & valid[:-1] & ~jumps).tolist()]
        points = zip(joined, valid.tolist(), (pixels + 0.5).tolist(), strict=True)
        path = "".join(f"{'L' if on else 'M'}{u:.1f} {v:.1f}" for on, there, (u, v) in points if there)
        shapes.append(f'<path d="{path}"><title>{angle} degrees from the axis</title></path>')
    label = f"circles every {step} degrees from the axis, {width} x {height} px"
    return (
        f'{text}<svg viewBox="0 0 {width} {height}" width="{_WIDTH}" role="img" aria-label="{label}" fill="none" '
        f'stroke="currentColor" stroke-width="{width / _WIDTH:.2f}" style="border: 1px solid; overflow: hidden">'
        f"{''.join(shapes)}</svg><div>{label}</div>"
    )
