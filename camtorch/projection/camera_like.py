"""The protocol of a camera within camtorch; `Camera` is one, and no package below cameras/ imports it."""

from typing import TYPE_CHECKING, Any, ClassVar

from torch import Tensor

from camtorch.evaluate.kept import Kept
from camtorch.optics.model_spec import ModelSpec
from camtorch.values.arguments import Numbers
from camtorch.values.module import BatchedModule


class CameraLike(ModelSpec, BatchedModule):
    """A model with numbers: tensors, a size, a form, and both directions."""

    is_mixed: ClassVar[bool] = False
    """Whether it is a batch of several models, which do not share coefficients; see `Mixed`."""
    has_native_form: ClassVar[bool] = True
    """Whether native code may know it as one `Native`: not several models, nor a camera behind a shutter."""
    image_size: tuple[int, int] | None
    _memo: Kept
    _rays: Kept
    _fields: Kept
    _expects_unusable: bool = False  # as of a network's numbers, or of those that a fit tries
    _told: bool = False  # whether a call has warned of unusable numbers

    if TYPE_CHECKING:
        intrinsics: Tensor
        distortion: Tensor

        # what other packages ask of cameras, and users do not: neither `dir` nor the API pages list it

        @property
        def tensors(self) -> tuple[Tensor, ...]: ...
        @property
        def form(self) -> tuple[object, ...]: ...
        def size_for(self, what: str) -> tuple[int, int]: ...
        @property
        def K(self) -> Tensor: ...  # noqa: N802
        @property
        def fov(self) -> Tensor: ...

        def project(self, points: Numbers) -> tuple[Tensor, Tensor]: ...
        def unproject(self, pixels: Numbers) -> tuple[Tensor, Tensor]: ...
        def rays(self, stride: int = 1) -> tuple[Tensor, Tensor]: ...
        def pixel_grid(self, stride: int = 1) -> Tensor: ...
        def _evaluate(self, direction: Any, rows: Tensor, lead: Any, tensors: Any) -> tuple[Tensor, Tensor]: ...
