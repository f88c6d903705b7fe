"""The tiles over the blocks: each from the images and meshes of the finer ones below it."""

from __future__ import annotations

import cv2

from localizer.synth.buildings.model import ROOT, TOP
from localizer.synth.config import BLOCK_M, TOP_M
from localizer.synth.paint.covers import new_image
from localizer.synth.tiles.bake import Baker, TilePart, half_size
from localizer.synth.tiles.charts import ChartedMesh
from localizer.synth.tiles.write import TileNode


def assemble_top(baker: Baker, column: int, row: int, parts: list[TilePart]) -> TilePart:
    """Write the 400 m tile (column, row from south-west) over its four blocks `parts`; returns its
    part for the tile above.
    """
    half = baker.scene.plan.config.half_m
    west, north = column * TOP_M - half, (row + 1) * TOP_M - half
    n = parts[0].ground.shape[0]
    image = new_image(2 * n, 2 * n)
    for part in parts:
        i, j = round((north - part.north) / BLOCK_M) * n, round((part.west - west) / BLOCK_M) * n
        image[i : i + n, j : j + n] = part.ground
    mesh = ChartedMesh.merged([p.mesh for p in parts])
    node = baker.write(TOP, (column, row), west, north, image, mesh)
    node.children = [child for p in parts for child in p.nodes]
    return TilePart([node], half_size(half_size(image)), mesh.at_level(ROOT).halved(2), west, north)


def assemble_root(baker: Baker, parts: list[TilePart]) -> TileNode:
    """Write the tile over the whole world, with trees painted on its ground."""
    half = baker.scene.plan.config.half_m
    n = parts[0].ground.shape[0]
    side = round(2 * half / TOP_M) * n
    image = new_image(side, side)
    for part in parts:
        i, j = round((half - part.north) / TOP_M) * n, round((part.west + half) / TOP_M) * n
        image[i : i + n, j : j + n] = part.ground
    gsd = 2 * half / side
    trees = baker.scene.plan.trees
    for (x, y), radius, seed in zip(trees.xy, trees.radius, trees.seed, strict=True):
        tone = 0.8 + 0.4 * ((int(seed) * 7919) % 101) / 101
        centre = (round((x + half) / gsd * 16 - 8), round((half - y) / gsd * 16 - 8))
        colour = (74 * tone, 88 * tone, 50 * tone)
        cv2.circle(image, centre, round(radius / gsd * 16), colour, -1, cv2.LINE_AA, 4)
    mesh = ChartedMesh.merged([p.mesh for p in parts])
    node = baker.write(ROOT, (0, 0), -half, half, image, mesh)
    node.children = [child for p in parts for child in p.nodes]
    return node
