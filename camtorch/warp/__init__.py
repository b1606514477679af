"""Images from one camera to another."""

from camtorch.warp.dewarp import Dewarp
from camtorch.warp.warp import Warp

__all__ = ["Dewarp", "Warp"]
