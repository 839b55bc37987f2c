"""Names the first value of a training step that is not finite (`numerics.finite_checks=true`).

Forward hooks check every tensor before the next module uses it, in the order of the flow: rays, samples, encoder, heads
and their circuits, weights, rendering. Only density may be infinite: volume rendering is defined for it.
`checked_trainer.py` adds loss terms, gradients and parameters.
"""

from collections.abc import Callable
from contextlib import ExitStack

import torch
from torch import Tensor, nn

from qnerf.model.model import Model
from qnerf.quantum import QuantumLayer
from qnerf.rendering.samplers import SampledRays
from qnerf.rendering.shading import Shaded
from qnerf.training.trainer import Diverged
from qnerf.types import Rays, Rendering

RayOf = Callable[[int], int | None]
"""Row of a tensor -> index of its ray in the batch; None: it belongs to no ray."""


class NonFinite(Diverged):
    """A value is not finite.

    Attributes:
        where: what the tensor is, such as "encoder" or "gradient of ...".
        values: the tensor.
        ray: index of the ray in the batch; None if the value belongs to no single ray.
        message: one line.
    """

    def __init__(self, where: str, values: Tensor, ray_of: RayOf | None) -> None:
        self.where, self.values = where, values.detach()
        wrong = ~torch.isfinite(self.values)
        index = tuple(wrong.nonzero()[0].tolist())
        count = f": {int(wrong.sum())} of {wrong.numel()} values, first [{', '.join(map(str, index))}]" if index else ""
        self.message = f"{float(self.values[index])} in {where}{count}"
        every_row = len(wrong) > 1 and bool(wrong.reshape(len(wrong), -1).any(1).all()) if index else True
        self.ray = None if ray_of is None or every_row else ray_of(index[0])
        super().__init__(self.message)


def check_finite(where: str, values: Tensor, ray_of: RayOf | None = None) -> None:
    """Raises `NonFinite` unless all values are finite."""
    if not bool(torch.isfinite(values.detach()).all()):
        raise NonFinite(where, values, ray_of)


class FiniteChecks:
    """Context manager that checks what flows through a model and raises `NonFinite`."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self._hooks = ExitStack()
        self._unit: Tensor | None = None  # (R, K, 3) all samples of the step in the unit cube

    def __enter__(self) -> None:
        model, field = self.model, self.model.field
        self._hook(model, self._rays, self._rendering)
        self._hook(model.sampler, None, self._samples)
        self._hook(field.contraction, None, self._points)
        self._hook(field.encoder, None, self._encoded)
        self._hook(model.shading, self._weights, self._chosen)
        self._head("density head", field.density_head, self._ray_of_point)
        self._head("colour head", field.color_head, self._ray_of_color)

    def __exit__(self, *_: object) -> None:
        self._hooks.close()
        self._unit = None

    def _hook(self, module: nn.Module, before: Callable[..., None] | None, after: Callable[..., None]) -> None:
        if before is not None:
            self._hooks.callback(module.register_forward_pre_hook(lambda _, inputs: before(*inputs)).remove)
        self._hooks.callback(module.register_forward_hook(lambda _, inputs, out: after(out, *inputs)).remove)

    def _head(self, name: str, head: nn.Module, ray_of: RayOf) -> None:
        circuits = [module for module in head.modules() if isinstance(module, QuantumLayer)]
        modules = [(name, head), *((f"circuit {number} of the {name}", c) for number, c in enumerate(circuits))]
        for where, module in modules:

            def before(inputs: Tensor, where: str = where) -> None:
                check_finite(f"inputs of {where}", inputs, ray_of)

            def after(out: Tensor, _: Tensor, where: str = where) -> None:
                check_finite(where, out, ray_of)

            self._hook(module, before, after)

    def _rays(self, rays: Rays) -> None:
        for name in ("origins", "directions", "near", "far"):
            check_finite(f"rays ({name})", getattr(rays, name), int)

    def _samples(self, sampled: SampledRays, *_: object) -> None:
        for number, (intervals, weights) in enumerate(sampled.proposals):
            check_finite(f"samples of proposal network {number}", intervals.edges, int)
            check_finite(f"weights of proposal network {number}", weights, int)
        check_finite("samples", sampled.samples.edges, int)
        check_finite("samples (normalised)", sampled.samples.spacing, int)

    def _points(self, unit: Tensor, _: Tensor) -> None:
        check_finite("contracted points", unit, int)
        self._unit = unit

    def _encoded(self, features: Tensor, points: Tensor) -> None:
        self._encoded_points = points
        check_finite("encoder", features, self._ray_of_point)

    def _weights(self, shares: Tensor, *_: object) -> None:
        check_finite("shares", shares, int)

    def _chosen(self, shaded: Shaded, *_: object) -> None:
        check_finite("shading (shares)", shaded.shares, int)
        check_finite("shading (geometry)", shaded.geometry, int)
        self._shaded = torch.ones_like(shaded.shares, dtype=torch.bool) if shaded.mask is None else shaded.mask

    def _rendering(self, out: tuple[Rendering, SampledRays, Tensor | None], _: Rays) -> None:
        for name in ("color", "depth", "accumulation"):
            check_finite(f"rendering ({name})", getattr(out[0], name), int)

    def _ray_of_point(self, row: int) -> int | None:
        """Finds the encoded point among all samples, because the mask leaves samples out.

        None while the occupancy grid is updated, which happens before rays are sampled.
        """
        if self._unit is None:
            return None
        return int((self._unit == self._encoded_points[row]).all(-1).nonzero()[0, 0])

    def _ray_of_color(self, row: int) -> int:
        return int(self._shaded.nonzero()[row, 0])
