"""`heightfield.render.render` for many views at once on any torch device.

It walks the same rays over the same samples as the CPU's kernel, all rays in step: the depths are
equal but for float32 rounding, which now and then moves a silhouette by a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.synth.heightfield.scene import BLOCK, LitScene

_FACADES = 4096  # rows that are kept for a scene's prisms
CHUNK = {"cuda": 16_000_000, "cpu": 400_000}  # rays that are walked together
_SWEEP = 8  # steps between two looks for rays that are finished


class ScenePool:
    """Lit scenes of n x n cells in numbered slots of one device's memory."""

    def __init__(self, slots: int, cells: int, device: torch.device) -> None:
        self.cells, self.device = cells, device
        sides = [cells]
        while sides[-1] % 2 == 0 and sides[-1] > 32:
            sides.append(sides[-1] // 2)
        self.sides = torch.tensor(sides, device=device)
        starts = [0]
        for side in sides:
            starts.append(starts[-1] + side * side)
        self.starts = torch.tensor(starts[:-1], device=device)
        blocks = cells // BLOCK
        new = {"device": device, "dtype": torch.float32}
        self.height = torch.zeros(slots, cells * cells, **new)
        self.block_max = torch.zeros(slots, blocks * blocks, **new)
        self.texture = torch.zeros(slots, starts[-1], 3, **new)
        self.prism = torch.zeros(slots, cells * cells, device=device, dtype=torch.int32)
        self.facades = torch.zeros(slots, _FACADES, 4, **new)
        # Sun's direction, direct and ambient light, sky's colour, cell size, highest point.
        self.scalars = torch.zeros(slots, 10, **new)

    def put(self, slot: int, scene: LitScene) -> None:
        """Copy a scene of the pool's `cells` into a slot, over what was there."""
        count = min(len(scene.facades), _FACADES)
        self.height[slot] = torch.from_numpy(scene.height).flatten()
        self.block_max[slot] = torch.from_numpy(scene.block_max).flatten()
        self.texture[slot] = torch.from_numpy(scene.mips).view(-1, 3)
        self.prism[slot] = torch.from_numpy(scene.prism).flatten().clamp(max=_FACADES - 1)
        self.facades[slot, :count] = torch.from_numpy(scene.facades[:count])
        light = scene.light
        values = [*light.sun, light.direct, light.ambient, *scene.sky, scene.cell_m]
        self.scalars[slot] = torch.tensor([*values, float(scene.height.max())])


def render(
    pool: ScenePool,
    slots: Sequence[int],
    poses: Sequence[Pose],
    cameras: Sequence[Camera],
    supersample: int = 1,
) -> tuple[Tensor, Tensor]:
    """Views of scenes by slot: images (B, H, W, 3) uint8 and depths (B, H, W) float32, 0 = sky.

    The cameras (world_from_camera poses) may differ in focal length, not in size.
    """
    rays = cameras[0].width * cameras[0].height * supersample**2
    some = max(CHUNK.get(pool.device.type, 400_000) // rays, 1)
    parts = [
        _render(pool, slots[k : k + some], poses[k : k + some], cameras[k : k + some], supersample)
        for k in range(0, len(slots), some)
    ]
    return torch.cat([image for image, _ in parts]), torch.cat([depth for _, depth in parts])


@dataclass(frozen=True)
class _Rays:
    """(R,) each: slot, origin in cells and metres, direction per metre along the axis in cells and
    metres, size of a pixel at one metre; cell size.
    """

    slot: Tensor
    px: Tensor
    py: Tensor
    pz: Tensor
    rx: Tensor
    ry: Tensor
    rz: Tensor
    pixel: Tensor
    cell: Tensor

    def __getitem__(self, chosen: Tensor) -> _Rays:
        return _Rays(*(value[chosen] for value in vars(self).values()))

    def at(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cells, cells and metres at `t`."""
        return self.px + t * self.rx, self.py + t * self.ry, self.pz + t * self.rz


def _render(
    pool: ScenePool,
    slots: Sequence[int],
    poses: Sequence[Pose],
    cameras: Sequence[Camera],
    supersample: int,
) -> tuple[Tensor, Tensor]:
    big = [c.resized(c.width * supersample, c.height * supersample) for c in cameras]
    rays = _rays(pool, slots, poses, big)
    scalars = pool.scalars[rays.slot]
    image, depth = scalars[:, 5:8].clone(), torch.zeros_like(rays.rz)
    down = torch.nonzero(rays.rz <= -1e-3)[:, 0]
    found, t = _march(pool, rays[down], scalars[down, 9])
    hit = down[found]
    depth[hit] = t
    image[hit] = _shade(pool, rays[hit], t)
    size = (len(slots), big[0].height, big[0].width)
    image, depth = image.view(*size, 3), depth.view(size)
    if supersample > 1:
        s = supersample
        image = F.avg_pool2d(image.permute(0, 3, 1, 2), s).permute(0, 2, 3, 1)
        depth = depth[:, s // 2 :: s, s // 2 :: s]
    return (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8).contiguous(), depth.contiguous()


def _rays(
    pool: ScenePool, slots: Sequence[int], poses: Sequence[Pose], cameras: Sequence[Camera]
) -> _Rays:
    width, height = cameras[0].width, cameras[0].height
    new = {"device": pool.device, "dtype": torch.float32}
    K = torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in cameras], **new)[:, :, None, None]
    v, u = torch.meshgrid(
        torch.arange(height, **new) + 0.5, torch.arange(width, **new) + 0.5, indexing="ij"
    )
    a, b = (u - K[:, 2]) / K[:, 0], (v - K[:, 3]) / K[:, 1]
    R = torch.stack([torch.from_numpy(p.rotation) for p in poses]).to(**new)
    direction = torch.einsum("kij,kjhw->kihw", R, torch.stack([a, b, torch.ones_like(a)], 1))
    center = torch.stack([torch.from_numpy(p.translation) for p in poses]).to(**new)
    slot = torch.tensor(list(slots), device=pool.device)
    cell = pool.scalars[slot, 8]

    def spread(per_view: Tensor) -> Tensor:
        return per_view[:, None, None].expand(-1, height, width).reshape(-1)

    return _Rays(
        spread(slot),
        spread(center[:, 0] / cell),
        spread(center[:, 1] / cell),
        spread(center[:, 2]),
        (direction[:, 0] / cell[:, None, None]).reshape(-1),
        (direction[:, 1] / cell[:, None, None]).reshape(-1),
        direction[:, 2].reshape(-1),
        spread(1.0 / K[:, 0, 0, 0]),
        spread(cell),
    )


def _march(pool: ScenePool, rays: _Rays, top: Tensor) -> tuple[Tensor, Tensor]:
    """Indices of the rays that meet the ground, and their distances along the axis, metres.

    A ray either skips a block that is wholly below it or walks through one; see `heightfield`.
    """
    t = torch.clamp((top - rays.pz) / rays.rz, min=0.5)
    count = torch.arange(len(t), device=t.device)
    low, out, step = t.clone(), t.clone(), torch.zeros_like(t)
    walking, hit = torch.zeros_like(t, dtype=torch.bool), torch.zeros_like(t, dtype=torch.bool)
    far = 6000.0 * rays.cell
    speed = torch.maximum(torch.hypot(rays.rx, rays.ry), -0.7 * rays.rz / rays.cell)
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    active = rays
    while len(count):
        for _ in range(_SWEEP):
            exit_, peak = _block(pool, active, t, far, speed)
            skipping = ~(walking | hit) & (t < far)
            clear = skipping & (active.pz + exit_ * active.rz > peak)
            enter = skipping & ~clear
            out = torch.where(skipping, exit_, out)
            low = torch.where(clear, t, low)
            t = torch.where(clear, exit_, t)
            t = torch.where(enter, torch.maximum(t, (peak - active.pz) / active.rz), t)
            pace = 0.6 * torch.clamp(0.7 * t * active.pixel / active.cell, min=1.0) / speed
            step = torch.where(enter, pace, step)
            walking = walking | enter
            left = walking & (t >= out)
            t = torch.where(left, out, t)
            walking = walking & ~left
            x, y, z = active.at(t)
            met = walking & (z <= _surface(pool, active.slot, x, y))
            hit = hit | met
            walking = walking & ~met
            low = torch.where(walking, t, low)
            t = torch.where(walking, t + step, t)
        if bool(hit.any()):
            found.append((count[hit], low[hit], t[hit]))
        keep = torch.nonzero(~hit & (walking | (t < far)))[:, 0]
        active = active[keep]
        count, t, low, out, step, walking, hit, far, speed = (
            value[keep] for value in (count, t, low, out, step, walking, hit, far, speed)
        )
    if not found:
        return count, t
    index, low, high = (torch.cat(values) for values in zip(*found, strict=True))
    return index, _bisected(pool, rays[index], low, high)


def _block(
    pool: ScenePool, rays: _Rays, t: Tensor, far: Tensor, speed: Tensor
) -> tuple[Tensor, Tensor]:
    """Where a ray leaves the block that it is in at `t`, and the highest point of the block."""
    x, y, _ = rays.at(t)
    bx, by = torch.floor(x / BLOCK), torch.floor(y / BLOCK)
    leave_x = _leaving(bx, rays.px, rays.rx, far)
    leave_y = _leaving(by, rays.py, rays.ry, far)
    # The last term is progress where float32 is coarser than the thousandth of a cell.
    out = torch.maximum(torch.minimum(leave_x, leave_y), t) + 1e-3 / speed + 2e-7 * t
    blocks = pool.cells // BLOCK
    column = (_mirror((bx + 0.5) * BLOCK, pool.cells) / BLOCK).long().clamp(max=blocks - 1)
    row = (_mirror((by + 0.5) * BLOCK, pool.cells) / BLOCK).long().clamp(max=blocks - 1)
    return out, pool.block_max[rays.slot, row * blocks + column]


def _leaving(block: Tensor, start: Tensor, rate: Tensor, far: Tensor) -> Tensor:
    edge = torch.where(rate > 0, block + 1, block) * BLOCK
    at = torch.minimum((edge - start) / rate, far)
    return torch.where(rate.abs() > 1e-9, at, far)


def _mirror(x: Tensor, n: int) -> Tensor:
    x = torch.remainder(x, 2 * n)
    return torch.where(x > n, 2 * n - x, x)


def _corner(pool: ScenePool, x: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    a = (_mirror(x, pool.cells) - 0.5).clamp(0.0, pool.cells - limit)
    index = a.long()
    return index, a - index


def _surface(pool: ScenePool, slot: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Bilinear height at cell coordinates, mirrored; cell centres at +0.5."""
    j, u = _corner(pool, x, 1.001)
    i, v = _corner(pool, y, 1.001)
    flat, at = pool.height.view(-1), slot * pool.cells**2 + i * pool.cells + j
    top = torch.lerp(flat[at], flat[at + 1], u)
    bottom = torch.lerp(flat[at + pool.cells], flat[at + pool.cells + 1], u)
    return torch.lerp(top, bottom, v)


def _bisected(pool: ScenePool, rays: _Rays, low: Tensor, high: Tensor) -> Tensor:
    for _ in range(10):
        middle = 0.5 * (low + high)
        x, y, z = rays.at(middle)
        below = z <= _surface(pool, rays.slot, x, y)
        high, low = torch.where(below, middle, high), torch.where(below, low, middle)
    return high


def _shade(pool: ScenePool, rays: _Rays, t: Tensor) -> Tensor:
    """Colours (R, 3) of the surface that the rays meet: facade on a prism's wall, else texture."""
    x, y, z = rays.at(t)
    x, y = _mirror(x, pool.cells), _mirror(y, pool.cells)
    footprint = t * rays.pixel / rays.cell
    color = _textured(pool, rays.slot, x, y, footprint)
    wall, walled = _facade(pool, rays, x, y, z, footprint)
    return torch.where(walled[:, None], wall, color)


def _textured(pool: ScenePool, slot: Tensor, x: Tensor, y: Tensor, footprint: Tensor) -> Tensor:
    level = (torch.log2(footprint.clamp(min=1e-6)) + 0.5).long()
    level = torch.where(footprint > 1.0, level, 0).clamp(0, len(pool.sides) - 1)
    side = pool.sides[level]
    top = side - 1.001
    a = torch.minimum((x * side / pool.cells - 0.5).clamp(min=0.0), top)
    b = torch.minimum((y * side / pool.cells - 0.5).clamp(min=0.0), top)
    j, i = a.long(), b.long()
    p, q = (a - j)[:, None], (b - i)[:, None]
    flat = pool.texture.view(-1, 3)
    at = slot * pool.texture.shape[1] + pool.starts[level] + i * side + j
    upper = torch.lerp(flat[at], flat[at + 1], p)
    lower = torch.lerp(flat[at + side], flat[at + side + 1], p)
    return torch.lerp(upper, lower, q)


def _facade(
    pool: ScenePool, rays: _Rays, x: Tensor, y: Tensor, z: Tensor, footprint: Tensor
) -> tuple[Tensor, Tensor]:
    """Colours (R, 3) of the walls, and which rays meet one."""
    n = pool.cells
    j, i = (x - 0.5).clamp(0.0, n - 2.0).long(), (y - 0.5).clamp(0.0, n - 2.0).long()
    at = rays.slot * n * n + i * n + j
    corners = at[:, None] + torch.tensor([0, 1, n, n + 1], device=at.device)
    h = pool.height.view(-1)[corners]
    lowest, highest = h.min(1).values, h.max(1).values
    rise = highest - lowest
    steep = (rise > 1.8) & (rise > 1.5 * rays.cell) & (z < highest - 0.3)
    # Of several corners of the same height the last one counts.
    last = torch.arange(4, device=h.device)
    index = torch.where(h == highest[:, None], last, -1).max(1, keepdim=True).values
    owner = pool.prism.view(-1)[corners.gather(1, index)[:, 0]].long()
    facade = pool.facades[rays.slot, owner]
    scalars = pool.scalars[rays.slot]
    gx = 0.5 * (h[:, 1] - h[:, 0] + h[:, 3] - h[:, 2])
    gy = 0.5 * (h[:, 2] - h[:, 0] + h[:, 3] - h[:, 1])
    length = torch.hypot(gx, gy).clamp(min=1e-6)
    nx, ny = -gx / length, -gy / length
    facing = (nx * scalars[:, 0] + ny * scalars[:, 1]).clamp(min=0.0)
    lit = scalars[:, 4] * 0.8 + scalars[:, 3] * facing
    window = facade[:, 3]
    along = (x * ny - y * nx) * rays.cell / window.clamp(min=1e-3)
    storey = torch.frac((highest - z) / 3.0)
    pane = (along - torch.floor(along) > 0.55) & (storey > 0.3) & (storey < 0.8)
    pane &= (window > 0.0) & (footprint * rays.cell < 0.6 * window)
    lit = torch.where(pane, 0.35 * lit, lit)
    return facade[:, :3] * lit[:, None], steep & (owner > 0)
