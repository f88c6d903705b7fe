"""The two losses: contrast over the projected location, and Eq. 3 through differentiable LM.

Shapes: B pairs, N anchors a pair, C channels. Pixels have centres at +0.5, as everywhere. `K`
(B, 4) is fx, fy, cx, cy at image scale; a level of stride s divides it by s.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

_WINDOW = 5  # half side, in cells, of the neighbourhood that gives the hard negatives


@dataclass(frozen=True)
class Batch:
    """Tensors of one training step.

    images: (2B, 3, H, W), references first. points: (B, N, 3) in the reference camera.
    reference_pixels, query_pixels: (B, N, 2). visible: (B, N) float, 1 where the query sees the
    anchor. query_from_reference: (B, 4, 4). K_query: (B, 4).
    """

    images: Tensor
    points: Tensor
    reference_pixels: Tensor
    query_pixels: Tensor
    visible: Tensor
    query_from_reference: Tensor
    K_query: Tensor


def sample(feature: Tensor, pixels: Tensor) -> Tensor:
    """Bilinear values (B, N, C) of `feature` (B, C, h, w) at level pixels (B, N, 2)."""
    top, bottom, ay, _ = _corners(feature, pixels)
    return top + ay * (bottom - top)


def contrast_loss(
    reference: Tensor,
    query: Tensor,
    truth: Tensor,
    visible: Tensor,
    scale: Tensor,
    count: int,
    whole_map_cells: int,
) -> Tensor:
    """Cross entropy of finding each anchor's true position (B, N, 2, level pixels) in the query.

    reference: (B, N, C) anchor features; query: (B, C, h, w); visible: (B, N) mask; scale: factor
    of the similarities. Levels of at most `whole_map_cells` are searched completely. On finer ones
    the negatives are the neighbourhood, which decides the basin of convergence, for `count` of the
    anchors.
    """
    if query.shape[2] * query.shape[3] <= whole_map_cells:
        loss = _whole_map(reference, query, truth, scale)
        return _mean(loss, visible)
    chosen = slice(0, count)
    loss = _neighbourhood(reference[:, chosen], query, truth[:, chosen], scale)
    return _mean(loss, visible[:, chosen])


def alignment_loss(
    batch: Batch,
    reference: tuple[Tensor, Tensor],
    query: tuple[Tensor, Tensor],
    stride: int,
    start: Tensor,
    iterations: int,
) -> tuple[Tensor, Tensor]:
    """Eq. 3: Barron's loss of the reprojection error after each LM iteration on one level.

    reference: anchor features (B, N, C) and confidences (B, N); query: maps (B, C, h, w) and (B, h,
    w) of a level of this stride; start: (B, 4, 4) initial query_from_reference. Returns the loss
    and each pair's pixel error (B,) (image pixels, mean over visible anchors) after the last
    iteration.
    """
    pose = start
    total = reference[0].new_zeros(())
    errors = total.expand(len(start))
    for k in range(iterations):
        pose = lm_step(pose, batch.points, reference, query, batch.K_query / stride)
        pixels, _ = project(pose, batch.points, batch.K_query)
        squared = ((pixels - batch.query_pixels) ** 2).sum(-1).clamp(max=1e5)
        weight = 1.0 if k == iterations - 1 else 0.5
        total = total + weight * _mean(barron(squared, stride / 2), batch.visible, cap=20.0)
        errors = _per_pair(squared.detach().sqrt(), batch.visible)
    return total, errors


def lm_step(
    pose: Tensor,
    points: Tensor,
    reference: tuple[Tensor, Tensor],
    query: tuple[Tensor, Tensor],
    K: Tensor,
    damping: float = 0.05,
) -> Tensor:
    """One differentiable Levenberg-Marquardt step of the feature-metric cost (paper, Eqs. 6-9) from
    query_from_reference `pose`; returns the next. reference, query: as of `alignment_loss`; K: (B,
    4) of the level.
    """
    features, confidence = query
    h, w = features.shape[2:]
    pixels, local = project(pose, points, K)
    z = local[..., 2]
    limit = pixels.new_tensor([w - 1.0, h - 1.0])
    inside = ((pixels > 1.0) & (pixels < limit)).all(-1) & (z > 1.0)
    at = pixels.detach() if not pixels.requires_grad else pixels
    top, bottom, ay, across = _corners(features, at)
    value = top + ay * (bottom - top)
    residual = value - reference[0]
    # Analytic gradient of the bilinear interpolant: (B, N, C, 2).
    gradient = torch.stack([across, bottom - top], -1)
    weight = reference[1] * sample(confidence[:, None], at)[..., 0] * inside
    norm = residual.detach().norm(dim=-1).clamp(min=1e-6)
    weight = weight * (0.5 / norm).clamp(max=1.0)  # Huber, as at run time
    A = gradient.transpose(-1, -2) @ gradient
    b = (gradient * residual[..., None]).sum(-2)
    J = _projection_jacobian(local, K)
    scaled = J * J.new_tensor([10.0, 10.0, 10.0, 0.1, 0.1, 0.1])
    H = torch.einsum("bn,bnia,bnij,bnjc->bac", weight, scaled, A, scaled)
    g = torch.einsum("bn,bnia,bni->ba", weight, scaled, b)
    H = H + torch.diag_embed(damping * H.diagonal(dim1=1, dim2=2) + 1e-3)
    step = -torch.linalg.solve(H, g) * g.new_tensor([10.0, 10.0, 10.0, 0.1, 0.1, 0.1])
    step = torch.nan_to_num(step)
    step = torch.cat([step[:, :3].clamp(-12.0, 12.0), step[:, 3:].clamp(-0.25, 0.25)], 1)
    return se3_exp(step) @ pose


def project(pose: Tensor, points: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (B, N, 2) and camera coordinates (B, N, 3) of points (B, N, 3) under (B, 4, 4)."""
    local = points @ pose[:, :3, :3].transpose(1, 2) + pose[:, None, :3, 3]
    z = local[..., 2].clamp(min=1.0)
    u = K[:, None, 0] * local[..., 0] / z + K[:, None, 2]
    v = K[:, None, 1] * local[..., 1] / z + K[:, None, 3]
    return torch.stack([u, v], -1), local


def barron(squared: Tensor, scale: float) -> Tensor:
    """Barron's general robust loss at alpha = 1 (Charbonnier) of squared errors."""
    return torch.sqrt(squared / scale**2 + 1.0) - 1.0


def se3_exp(xi: Tensor) -> Tensor:
    """SE(3) exponential (B, 4, 4) of (rho, phi), (B, 6)."""
    zero = torch.zeros_like(xi[:, 0])
    x, y, z = xi[:, 3], xi[:, 4], xi[:, 5]
    rows = [
        torch.stack([zero, -z, y, xi[:, 0]], -1),
        torch.stack([z, zero, -x, xi[:, 1]], -1),
        torch.stack([-y, x, zero, xi[:, 2]], -1),
        torch.zeros_like(xi[:, :4]),
    ]
    return torch.matrix_exp(torch.stack(rows, 1))


def _corners(feature: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Bilinear parts at level pixels (B, N, 2): upper and lower row values (B, N, C), the vertical
    fraction (B, N, 1), and the horizontal derivative (B, N, C).
    """
    h, w = feature.shape[2:]
    pixels = torch.nan_to_num(pixels) - 0.5
    x, y = pixels[..., 0].clamp(0, w - 1.001), pixels[..., 1].clamp(0, h - 1.001)
    x0, y0 = x.detach().floor(), y.detach().floor()
    ax, ay = (x - x0)[..., None], (y - y0)[..., None]
    index = y0.long() * w + x0.long()
    f00, f01, f10, f11 = _cells(feature, index[..., None] + index.new_tensor([0, 1, w, w + 1]))
    dx0, dx1 = f01 - f00, f11 - f10
    return f00 + ax * dx0, f10 + ax * dx1, ay, dx0 + ay * (dx1 - dx0)


def _cells(feature: Tensor, index: Tensor) -> tuple[Tensor, ...]:
    """The cells `index` (B, N, k) of each map of `feature` (B, C, h, w), as k tensors (B, N, C).

    Whole rows of a channels-last copy are read: several times faster than gathering channels.
    """
    batch, channels, h, w = feature.shape
    rows = feature.permute(0, 2, 3, 1).reshape(-1, channels)
    first = torch.arange(batch, device=feature.device) * (h * w)
    flat = (index + first[:, None, None]).permute(2, 0, 1)
    cells: tuple[Tensor, ...] = (
        rows.index_select(0, flat.reshape(-1)).view(*flat.shape, channels).unbind(0)
    )
    return cells


def _projection_jacobian(local: Tensor, K: Tensor) -> Tensor:
    """(B, N, 2, 6): pixels by a left increment (rho, phi) of the pose."""
    x, y, z = local[..., 0], local[..., 1], local[..., 2].clamp(min=1.0)
    zero = torch.zeros_like(x)
    fx, fy = K[:, None, 0] / z, K[:, None, 1] / z
    gx, gy = -fx * x / z, -fy * y / z
    row0 = [fx, zero, gx, gx * y, fx * z - gx * x, -fx * y]
    row1 = [zero, fy, gy, gy * y - fy * z, -gy * x, fy * x]
    return torch.stack([torch.stack(row0, -1), torch.stack(row1, -1)], -2)


def _whole_map(reference: Tensor, query: Tensor, truth: Tensor, scale: Tensor) -> Tensor:
    w = query.shape[3]
    h = query.shape[2]
    similarity = torch.einsum("bnc,bchw->bnhw", reference, query).flatten(2) * scale
    log_p = F.log_softmax(similarity, -1)
    at = truth - 0.5
    x0 = at[..., 0].floor().clamp(0, w - 2)
    y0 = at[..., 1].floor().clamp(0, h - 2)
    ax, ay = (at[..., 0] - x0).clamp(0, 1), (at[..., 1] - y0).clamp(0, 1)
    index = y0.long() * w + x0.long()
    loss = torch.zeros_like(ax)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        share = (ax if dx else 1 - ax) * (ay if dy else 1 - ay)
        loss = loss - share * log_p.gather(2, (index + dy * w + dx)[..., None])[..., 0]
    return loss


def _neighbourhood(reference: Tensor, query: Tensor, truth: Tensor, scale: Tensor) -> Tensor:
    """The window's centre lies exactly on the true place; the target is a narrow bell there."""
    similarity = window_similarity(reference, query, truth)
    reach = torch.arange(-_WINDOW, _WINDOW + 1, device=query.device, dtype=query.dtype)
    squared = (reach[:, None] ** 2 + reach[None] ** 2).flatten()
    target = torch.softmax(-squared / (2 * 0.5**2), 0)
    return -(F.log_softmax(similarity * scale, -1) * target).sum(-1)


def window_similarity(reference: Tensor, query: Tensor, truth: Tensor) -> Tensor:
    """Dot products (B, N, k) of anchor features (B, N, C) with the feature map (B, C, h, w), at the
    points of a square window about `truth` (B, N, 2, level pixels), row by row.

    All points of a window have the same sub-cell offset, and the product is linear in the features.
    So it is computed at whole cells and then interpolated.
    """
    h, w = query.shape[2:]
    side = 2 * _WINDOW + 1
    at = torch.nan_to_num(truth) - 0.5
    corner = at.floor()
    ax, ay = (at - corner)[..., None, None].unbind(2)
    steps = torch.arange(-_WINDOW, _WINDOW + 2, device=query.device)
    x = (corner[..., :1].long() + steps).clamp(0, w - 1)
    y = (corner[..., 1:].long() + steps).clamp(0, h - 1)
    index = (y[..., :, None] * w + x[..., None, :]).flatten(2)
    cells = torch.stack(_cells(query, index), 2)
    whole = (cells @ reference[..., None])[..., 0].unflatten(2, (side + 1, side + 1))
    across = whole[..., :-1] + ax * (whole[..., 1:] - whole[..., :-1])
    return (across[..., :-1, :] + ay * (across[..., 1:, :] - across[..., :-1, :])).flatten(2)


def _mean(values: Tensor, mask: Tensor, cap: float | None = None) -> Tensor:
    """Mean over masked anchors of each pair, capped per pair, then over pairs."""
    per_pair = _per_pair(values, mask)
    if cap is not None:
        per_pair = per_pair.clamp(max=cap)
    return per_pair.mean()


def _per_pair(values: Tensor, mask: Tensor) -> Tensor:
    return (values * mask).sum(1) / mask.sum(1).clamp(min=1.0)
