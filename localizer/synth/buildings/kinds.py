"""What each kind of building looks like: colours, roof, windows, and what stands on it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from localizer.synth.buildings.shell import (
    ALL_LEVELS,
    NEAR_LEVELS,
    NO_PARAMS,
    Building,
    Colour,
    Kind,
    Shell,
    Surface,
)
from localizer.synth.paint.covers import Cover, FacadeStyle

PLASTER: tuple[Colour, ...] = (
    (214, 208, 196), (222, 216, 206), (206, 192, 160), (214, 196, 156), (198, 178, 150),
    (206, 176, 160), (184, 180, 174), (196, 202, 196), (172, 160, 142), (220, 206, 178),
    (160, 150, 140), (190, 196, 204),
)  # fmt: skip
BRICK: tuple[Colour, ...] = ((150, 92, 74), (164, 108, 86), (140, 100, 84), (176, 128, 100))
TILE: tuple[Colour, ...] = (
    (158, 92, 68), (172, 104, 78), (146, 84, 64), (134, 92, 76), (122, 84, 70), (150, 110, 88),
    (108, 84, 76), (98, 92, 90), (84, 82, 84), (180, 118, 90), (116, 70, 58),
)  # fmt: skip
SHUTTER: tuple[Colour, ...] = (
    (92, 110, 84), (120, 66, 56), (84, 96, 116), (110, 84, 62), (140, 136, 128), (70, 92, 92),
)  # fmt: skip
SHEET: tuple[Colour, ...] = (
    (176, 180, 182), (150, 158, 164), (188, 184, 172), (128, 140, 152), (160, 130, 110),
    (196, 198, 198),
)  # fmt: skip
FLAT: tuple[Colour, ...] = (
    (132, 130, 128), (112, 110, 110), (156, 152, 146), (92, 92, 94), (170, 166, 158),
)  # fmt: skip


def build(building: Building) -> list[Surface]:
    """All surfaces of one building."""
    rng = np.random.default_rng([building.seed, 77])
    shell = Shell(building)
    _BUILDERS[building.kind](shell, rng)
    return shell.surfaces


def _pick(rng: np.random.Generator, colours: tuple[Colour, ...], vary: float = 7.0) -> Colour:
    colour = np.asarray(colours[rng.integers(len(colours))]) + rng.normal(0, vary, 3) * 0.6
    colour += rng.normal(0, vary)
    r, g, b = np.clip(colour, 30, 238)
    return (float(r), float(g), float(b))


def _dress_house(shell: Shell, rng: np.random.Generator) -> None:
    brick = rng.random() < 0.2
    shell.base = _pick(rng, BRICK if brick else PLASTER)
    shell.accent = _pick(rng, SHUTTER)
    style = FacadeStyle.BRICK if brick else FacadeStyle.HOUSE
    shell.params = (2.8, rng.uniform(2.3, 3.2), rng.uniform(0.95, 1.25), rng.uniform(1.2, 1.45),
                    rng.uniform(0.8, 1.0), float(style))  # fmt: skip
    shell.roof = _pick(rng, TILE)
    shell.roof_cover = Cover.SLATE if rng.random() < 0.15 else Cover.TILES
    skylights = 1.0 if rng.random() < 0.5 else 0.0
    solar = rng.uniform(0.12, 0.4) if rng.random() < 0.3 else 0.0
    shell.roof_params = (skylights, solar, rng.uniform(0.6, 0.9), 0.0, 0.0, 0.0)


def _chimney(shell: Shell, rng: np.random.Generator, x: float, y: float, ridge: float) -> None:
    w = rng.uniform(0.35, 0.55)
    side = _pick(rng, BRICK) if rng.random() < 0.6 else _pick(rng, PLASTER)
    shell.box((x - w, x + w), (y - w * 0.8, y + w * 0.8), (ridge - 2.2, ridge + 0.9), side,
              (86, 82, 80))  # fmt: skip


def _dormers(shell: Shell, rng: np.random.Generator, pitch: float, overhang: float) -> None:
    b = shell.building
    rise = b.width / 2 * np.tan(pitch)
    if rise < 3.0 or b.length < 9.0:
        return
    for side in (-1, 1):
        if rng.random() < 0.45:
            continue
        count = int(rng.integers(1, max(2, int(b.length / 4.5)) + 1))
        for x in np.linspace(-b.length / 2, b.length / 2, count + 2)[1:-1]:
            w, z0 = rng.uniform(0.8, 1.2), b.eaves_m + 0.7
            z1 = z0 + 1.5
            y0 = b.width / 2 - 0.7 / np.tan(pitch)  # the front stands where the slope is at z0
            y1 = y0 - 1.7 / np.tan(pitch)  # the lid meets the slope here
            top = z1 + 0.2
            front = [(x - w, -y0, z0), (x + w, -y0, z0), (x + w, -y0, z1), (x - w, -y0, z1)]
            lid = [(x - w - 0.2, -y0 - 0.3, z1), (x + w + 0.2, -y0 - 0.3, z1),
                   (x + w + 0.2, -y1, top), (x - w - 0.2, -y1, top)]  # fmt: skip
            left = [(x - w, -y1, top), (x - w, -y0, z0), (x - w, -y0, z1)]
            right = [(x + w, -y0, z0), (x + w, -y1, top), (x + w, -y0, z1)]
            for points, cover, colour in (
                (front, Cover.GLASS, (170, 168, 160)), (lid, Cover.METAL, (120, 112, 104)),
                (left, Cover.PLAIN, shell.base), (right, Cover.PLAIN, shell.base),
            ):  # fmt: skip
                array = np.asarray(points)
                if side > 0:
                    array = array * [-1, -1, 1]
                shell.add(array, cover, colour, levels=NEAR_LEVELS)


def _gable_house(shell: Shell, rng: np.random.Generator) -> None:
    _dress_house(shell, rng)
    b = shell.building
    pitch = rng.uniform(0.5, 0.85)
    overhang = rng.uniform(0.35, 0.7)
    x, y = (-b.length / 2, b.length / 2), (-b.width / 2, b.width / 2)
    ridge = shell.gable(x, y, b.eaves_m, pitch, overhang)
    _dormers(shell, rng, pitch, overhang)
    _chimney(shell, rng, rng.uniform(-0.3, 0.3) * b.length, rng.uniform(-1.2, 1.2), ridge)


def _hip_house(shell: Shell, rng: np.random.Generator) -> None:
    _dress_house(shell, rng)
    b = shell.building
    x, y = (-b.length / 2, b.length / 2), (-b.width / 2, b.width / 2)
    ridge = shell.hip(x, y, b.eaves_m, rng.uniform(0.42, 0.65))
    _chimney(shell, rng, rng.uniform(-0.15, 0.15) * b.length, rng.uniform(-1, 1), ridge)


def _l_house(shell: Shell, rng: np.random.Generator) -> None:
    _dress_house(shell, rng)
    b = shell.building
    pitch = rng.uniform(0.5, 0.75)
    main = b.width * rng.uniform(0.52, 0.62)
    y0 = -b.width / 2
    ridge = shell.gable((-b.length / 2, b.length / 2), (y0, y0 + main), b.eaves_m, pitch, 0.45)
    wing = min(main * rng.uniform(0.75, 0.95), b.length * 0.5)
    left = rng.random() < 0.5
    x0 = -b.length / 2 if left else b.length / 2 - wing
    shell.gable((x0, x0 + wing), (y0 + main * 0.5, b.width / 2), b.eaves_m, pitch, 0.45,
                along_x=False)  # fmt: skip
    _chimney(shell, rng, 0.0, y0 + main / 2 + 0.8, ridge)


def _row_house(shell: Shell, rng: np.random.Generator) -> None:
    b = shell.building
    units = max(2, round(b.length / 7.0))
    step = b.length / units
    pitch = rng.uniform(0.55, 0.75)
    _dress_house(shell, rng)
    roof = shell.roof
    for k in range(units):
        shell.base = _pick(rng, PLASTER)
        shell.accent = _pick(rng, SHUTTER)
        grey = rng.normal(0, 10)
        shell.roof = (roof[0] + grey, roof[1] + grey, roof[2] + grey)
        solar = rng.uniform(0.1, 0.3) if rng.random() < 0.25 else 0.0
        shell.roof_params = (float(rng.integers(0, 2)), solar, 0.85, 0.0, 0.0, 0.0)
        x0 = -b.length / 2 + k * step
        lift = rng.uniform(-0.25, 0.25)
        ridge = shell.gable((x0, x0 + step), (-b.width / 2, b.width / 2), b.eaves_m + lift, pitch,
                            0.12)  # fmt: skip
        _chimney(shell, rng, x0 + 0.6, rng.uniform(-1.5, 1.5), ridge)


def _furnish_flat(shell: Shell, rng: np.random.Generator, top: float, amount: float) -> None:
    b = shell.building
    a, c = b.length / 2 - 1.6, b.width / 2 - 1.6
    if a < 1.5 or c < 1.5:
        return
    if amount > 0.5 and b.length > 9:
        w, d = rng.uniform(1.3, 2.4), rng.uniform(1.3, 2.0)
        x, y = rng.uniform(-0.5, 0.5) * a, rng.uniform(-0.3, 0.3) * c
        shell.box((x - w, x + w), (y - d, y + d), (top, top + rng.uniform(2.2, 3.0)),
                  _pick(rng, PLASTER), _pick(rng, FLAT), ALL_LEVELS)  # fmt: skip
    for _ in range(int(rng.poisson(2.0 + b.length * b.width / 90.0 * amount))):
        w, d = rng.uniform(0.3, 1.2, 2)
        x, y = rng.uniform(-a, a), rng.uniform(-c, c)
        grey = rng.uniform(110, 215)
        shell.box((x - w, x + w), (y - d, y + d), (top, top + rng.uniform(0.4, 1.3)),
                  (grey, grey, grey * 0.98), (grey * 1.04, grey * 1.04, grey))  # fmt: skip


def _dress_flat(shell: Shell, rng: np.random.Generator) -> None:
    choice = rng.random()
    shell.roof_cover = (
        Cover.GRAVEL if choice < 0.45 else Cover.BITUMEN if choice < 0.8 else Cover.GREEN
    )
    shell.roof = _pick(rng, FLAT, 10.0)
    shell.roof_params = NO_PARAMS


def _flat_block(shell: Shell, rng: np.random.Generator) -> None:
    b = shell.building
    shell.base = _pick(rng, PLASTER)
    shell.accent = _pick(rng, SHUTTER)
    shell.params = (2.9, rng.uniform(2.4, 3.4), rng.uniform(1.2, 1.8), 1.4, 0.9,
                    float(FacadeStyle.APARTMENT))  # fmt: skip
    _dress_flat(shell, rng)
    x, y = (-b.length / 2, b.length / 2), (-b.width / 2, b.width / 2)
    shell.flat(x, y, b.eaves_m, rng.uniform(0.4, 0.9))
    if rng.random() < 0.4 and b.length > 14:  # set-back top storey
        k = rng.uniform(0.62, 0.8)
        shell.roof = _pick(rng, FLAT, 10.0)
        x, y = (x[0] * k, x[1] * k), (y[0] * 0.7, y[1] * 0.7)
        shell.flat(x, y, b.eaves_m + 2.9, 0.3)
    else:
        _furnish_flat(shell, rng, b.eaves_m, 1.0)


def _tower(shell: Shell, rng: np.random.Generator) -> None:
    _flat_block(shell, rng)
    b = shell.building
    w = min(b.length, b.width) * 0.22
    z = b.eaves_m
    shell.box((-w, w), (-w, w), (z, z + 3.4), (170, 168, 164), (120, 118, 116), ALL_LEVELS)


def _office(shell: Shell, rng: np.random.Generator) -> None:
    b = shell.building
    shell.base = _pick(rng, SHEET)
    shell.params = (3.5, 3.0, 2.4, 1.9, 0.9, float(FacadeStyle.OFFICE))
    _dress_flat(shell, rng)
    shell.flat((-b.length / 2, b.length / 2), (-b.width / 2, b.width / 2), b.eaves_m, 0.6)
    _furnish_flat(shell, rng, b.eaves_m, 1.6)


def _hall(shell: Shell, rng: np.random.Generator) -> None:
    b = shell.building
    shell.base, shell.accent = _pick(rng, SHEET), _pick(rng, SHUTTER)
    shell.params = (4.5, 5.0, 3.0, 1.0, 2.0, float(FacadeStyle.HALL))
    x, y = (-b.length / 2, b.length / 2), (-b.width / 2, b.width / 2)
    if rng.random() < 0.5:
        shell.roof_cover, shell.roof = Cover.METAL, _pick(rng, SHEET)
        shell.roof_params = (float(rng.integers(0, 2)), 0.0, 0.0, 0.0, 0.0, 0.0)
        shell.gable(x, y, b.eaves_m, rng.uniform(0.1, 0.2), 0.3)
    else:
        shell.roof_cover, shell.roof = Cover.BITUMEN, _pick(rng, FLAT, 10.0)
        shell.flat(x, y, b.eaves_m, 0.5)
        for _ in range(int(b.length * b.width / 260)):  # domed lights and fans
            u = rng.uniform(-0.42, 0.42) * b.length
            v = rng.uniform(-0.42, 0.42) * b.width
            shell.box((u - 1.2, u + 1.2), (v - 0.8, v + 0.8), (b.eaves_m, b.eaves_m + 0.5),
                      (180, 182, 182), (206, 212, 214))  # fmt: skip
        _furnish_flat(shell, rng, b.eaves_m, 0.5)


def _sawtooth(shell: Shell, rng: np.random.Generator) -> None:
    b = shell.building
    shell.base, shell.accent = _pick(rng, BRICK), _pick(rng, SHUTTER)
    shell.params = (4.5, 4.0, 2.2, 1.6, 1.6, float(FacadeStyle.BRICK))
    shell.roof_cover, shell.roof = Cover.METAL, _pick(rng, SHEET)
    h, half = b.eaves_m, b.width / 2
    shell.walls((-b.length / 2, b.length / 2), (-half, half), h)
    teeth = max(2, round(b.length / 9.0))
    step, rise = b.length / teeth, 2.6
    for k in range(teeth):
        x0 = -b.length / 2 + k * step
        x1 = x0 + step
        shell.slope([(x0, -half, h + rise), (x1, -half, h), (x1, half, h), (x0, half, h + rise)])
        shell.add([(x0, half, h), (x0, -half, h), (x0, -half, h + rise), (x0, half, h + rise)],
                  Cover.GLASS, (190, 192, 190))  # fmt: skip
        shell.add([(x0, -half, h), (x1, -half, h), (x0, -half, h + rise)], Cover.PLAIN, shell.base)
        shell.add([(x1, half, h), (x0, half, h), (x0, half, h + rise)], Cover.PLAIN, shell.base)


def _barn(shell: Shell, rng: np.random.Generator) -> None:
    b = shell.building
    shell.base = _pick(rng, ((120, 92, 70), (136, 110, 86), (104, 84, 70)))
    shell.params = (3.2, 4.5, 1.0, 0.8, 1.6, float(FacadeStyle.BARN))
    shell.roof, shell.roof_cover = _pick(rng, TILE), Cover.TILES
    if rng.random() < 0.35:
        shell.roof, shell.roof_cover = _pick(rng, SHEET), Cover.METAL
    solar = 0.08 if rng.random() < 0.45 else 0.0
    shell.roof_params = (0.0, solar, 0.92, 0.0, 0.0, 0.0)
    shell.gable((-b.length / 2, b.length / 2), (-b.width / 2, b.width / 2), b.eaves_m,
                rng.uniform(0.4, 0.6), 0.8)  # fmt: skip


def _shed(shell: Shell, rng: np.random.Generator) -> None:
    b = shell.building
    shell.base = _pick(rng, (*PLASTER, (120, 92, 70)))
    shell.params = (2.6, 3.0, 1.0, 0.8, 1.0, float(FacadeStyle.BLANK))
    x, y = (-b.length / 2, b.length / 2), (-b.width / 2, b.width / 2)
    if rng.random() < 0.5:
        shell.roof, shell.roof_cover = _pick(rng, FLAT, 10.0), Cover.BITUMEN
        shell.flat(x, y, b.eaves_m, 0.0)
    else:
        shell.roof, shell.roof_cover = _pick(rng, TILE), Cover.TILES
        shell.gable(x, y, b.eaves_m, rng.uniform(0.3, 0.6), 0.25)


def _church(shell: Shell, rng: np.random.Generator) -> None:
    b = shell.building
    shell.base = _pick(rng, ((206, 200, 186), (180, 168, 146), (214, 208, 200)))
    shell.params = (40.0, 5.0, 1.5, 4.0, 2.2, float(FacadeStyle.CHURCH))
    shell.roof, shell.roof_cover = _pick(rng, TILE[:6]), Cover.TILES
    half = b.length / 2
    shell.gable((-half + 6.0, half - 6.0), (-b.width / 2, b.width / 2), b.eaves_m, 0.85, 0.4)
    shell.hip((half - 6.5, half), (-b.width * 0.33, b.width * 0.33), b.eaves_m * 0.85, 0.7, 0.3)
    t = min(b.width * 0.3, 3.6)
    shell.params = (40.0, 3.4, 1.0, 3.0, b.eaves_m * 1.3, float(FacadeStyle.CHURCH))
    tower = b.eaves_m * rng.uniform(2.3, 2.8)
    if rng.random() < 0.5:
        shell.roof, shell.roof_cover = (96, 128, 112), Cover.METAL
    shell.hip((-half, -half + 2 * t), (-t, t), tower, rng.uniform(1.1, 1.3), 0.3)


def _silo(shell: Shell, rng: np.random.Generator) -> None:
    b = shell.building
    shell.base = _pick(rng, SHEET)
    radius, sides = b.width / 2, 14
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
    foot = b.foot_z - b.base_z
    for p, q in pairwise(ring):
        shell.add([(*p, foot), (*q, foot), (*q, b.eaves_m), (*p, b.eaves_m)], Cover.METAL,
                  shell.base)  # fmt: skip
        shell.add([(*p, b.eaves_m), (*q, b.eaves_m), (0, 0, b.eaves_m + radius * 0.4)], Cover.METAL,
                  shell.base)  # fmt: skip


def _tent(shell: Shell, rng: np.random.Generator) -> None:
    """A glasshouse of a nursery."""
    b = shell.building
    shell.base, shell.params = (170, 176, 172), (2.5, 2.0, 1.8, 1.8, 0.3, 4.0)
    shell.roof, shell.roof_cover = (188, 194, 190), Cover.GLASS
    shell.gable((-b.length / 2, b.length / 2), (-b.width / 2, b.width / 2), b.eaves_m, 0.45, 0.1)


def _deck(shell: Shell, rng: np.random.Generator) -> None:
    """A car-park building with bays painted on its roof."""
    b = shell.building
    shell.base = _pick(rng, PLASTER)
    shell.params = (2.8, 3.0, 2.6, 1.2, 1.0, float(FacadeStyle.OFFICE))
    shell.roof, shell.roof_cover = (142, 140, 138), Cover.DECK
    x, y = (-b.length / 2, b.length / 2), (-b.width / 2, b.width / 2)
    shell.flat(x, y, b.eaves_m, 1.0)
    shell.box((x[0] + 1, x[0] + 5), (y[0] + 1, y[0] + 4), (b.eaves_m, b.eaves_m + 2.8),
              (190, 188, 184), (130, 128, 126), ALL_LEVELS)  # fmt: skip


def _container(shell: Shell, rng: np.random.Generator) -> None:
    b = shell.building
    colour = _pick(rng, ((150, 70, 56), (64, 92, 130), (90, 120, 96), (196, 196, 192),
                         (190, 130, 60), (110, 112, 116)), 12.0)  # fmt: skip
    x, y = (-b.length / 2, b.length / 2), (-b.width / 2, b.width / 2)
    foot = b.foot_z - b.base_z
    for ax, ay, bx, by in ((x[0], y[0], x[1], y[0]), (x[1], y[0], x[1], y[1]),
                           (x[1], y[1], x[0], y[1]), (x[0], y[1], x[0], y[0])):  # fmt: skip
        shell.add([(ax, ay, foot), (bx, by, foot), (bx, by, b.eaves_m), (ax, ay, b.eaves_m)],
                  Cover.METAL, colour, levels=NEAR_LEVELS)  # fmt: skip
    shell.add([(x[0], y[0], b.eaves_m), (x[1], y[0], b.eaves_m), (x[1], y[1], b.eaves_m),
               (x[0], y[1], b.eaves_m)], Cover.METAL, colour, levels=ALL_LEVELS)  # fmt: skip


_BUILDERS = {
    Kind.GABLE: _gable_house,
    Kind.HIP: _hip_house,
    Kind.L_GABLE: _l_house,
    Kind.ROW: _row_house,
    Kind.FLAT: _flat_block,
    Kind.TOWER: _tower,
    Kind.OFFICE: _office,
    Kind.HALL: _hall,
    Kind.SAWTOOTH: _sawtooth,
    Kind.BARN: _barn,
    Kind.SHED: _shed,
    Kind.CHURCH: _church,
    Kind.SILO: _silo,
    Kind.TENT: _tent,
    Kind.DECK: _deck,
    Kind.CONTAINER: _container,
}
