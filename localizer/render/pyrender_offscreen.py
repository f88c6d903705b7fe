"""Renderer on pyrender (extra `pyrender`), tested for equality with the others.

Stock pyrender reads depth from a multisampled 24-bit buffer: errors of 5 to 10 cm, and metres at
edges. Here shaders write eye-space z to a float32 target without multisampling, and node poses are
relative to the camera, so that float32 is precise.
"""

from __future__ import annotations

import os
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("PYOPENGL_PLATFORM", "egl")  # before OpenGL is imported
os.environ.setdefault("PYGLET_HEADLESS", "true")  # pyrender imports it; X libraries may be missing

import cv2
import numpy as np
import pyrender
from OpenGL import GL
from OpenGL.plugins import FormatHandler
from pyrender.renderer import Renderer
from pyrender.shader_program import ShaderProgramCache

from localizer.errors import RenderError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.tile import TileMesh
from localizer.render.base import SKY, MapRenderer, TileProvider, clip_from_camera
from localizer.types import RenderedView

# PyOpenGL 3.1.0, which pyrender asks for, does not know what Python 3.12 calls references.
FormatHandler(
    "ctypesparameter",
    "OpenGL.arrays.ctypesparameters.CtypesParameterHandler",
    ["_ctypes.CArgObject"],
)

_REPEAT, _CLAMP_TO_EDGE = 10497, 33071
_LINEAR, _LINEAR_MIPMAP_NEAREST = 9729, 9985
_KEPT_MESHES = 512  # on the GPU at once

_VERTEX_SHADER = """#version 330 core
layout(location = 0) in vec3 position;
layout(location = TEXCOORD_0_LOC) in vec2 texcoord_0;
layout(location = INST_M_LOC) in mat4 inst_m;
uniform mat4 M;
uniform mat4 V;
uniform mat4 P;
out vec2 uv;
out float z;
void main() {
    vec4 p = M * inst_m * vec4(position, 1.0);
    uv = texcoord_0;
    z = p.z;
    gl_Position = P * p;
}"""

# The same choice of mip as in `moderngl_egl`; the material's roughness, which must be
# within 0 to 1, carries a 32nd of their number.
_FRAGMENT_SHADER = """#version 330 core
struct Material { sampler2D base_color_texture; float roughness_factor; };
uniform Material material;
in vec2 uv;
in float z;
layout(location = 0) out vec4 colour;
layout(location = 1) out float depth;
void main() {
    vec2 size = vec2(textureSize(material.base_color_texture, 0));
    vec2 a = dFdx(uv) * size, b = dFdy(uv) * size;
    float area = abs(a.x * b.y - a.y * b.x);
    float level = ceil(0.5 * log2(max(area, 1e-9) * 0.5));
    level = clamp(level, 0.0, 32.0 * material.roughness_factor - 1.0);
    colour = vec4(textureLod(material.base_color_texture, uv, level).rgb, 1.0);
    depth = z;
}"""


class PyrenderRenderer(MapRenderer):
    """Draws tiles with pyrender. Only the thread that made it may use it."""

    def __init__(self, streamer: TileProvider) -> None:
        """Open an EGL context; raises `RenderError` where there is none."""
        super().__init__(streamer)
        try:
            self._offscreen = pyrender.OffscreenRenderer(64, 64)
        except Exception as error:  # pyrender and PyOpenGL raise whatever EGL answers
            raise RenderError(f"pyrender finds no OpenGL through EGL: {error}") from error
        self._shaders = tempfile.TemporaryDirectory(prefix="pyrender-shaders-")
        folder = Path(self._shaders.name)
        (folder / "flat.vert").write_text(_VERTEX_SHADER)
        (folder / "flat.frag").write_text(_FRAGMENT_SHADER)
        self._offscreen._renderer = _ExactRenderer(64, 64, str(folder))  # noqa: SLF001
        self.name = "pyrender (OpenGL)"
        self._owner = threading.get_ident()
        self._sky = (*(c / 255 for c in SKY), 0.0)  # alpha 0 marks what nothing was drawn on
        self._meshes: OrderedDict[int, tuple[TileMesh, Any]] = OrderedDict()

    def draw(
        self, meshes: Sequence[TileMesh], world_from_camera: Pose, camera: Camera
    ) -> RenderedView:
        """Draw exactly these meshes. `RenderError` on a thread that did not make the renderer."""
        if threading.get_ident() != self._owner:
            raise RenderError("an OpenGL renderer was used by a thread that did not make it")
        scene = pyrender.Scene(bg_color=self._sky)
        scene.add(_Projection(camera), pose=np.eye(4))
        camera_from_world = world_from_camera.inverse
        for mesh in meshes:
            if len(mesh.faces):
                pose = (camera_from_world @ mesh.world_from_tile).matrix
                scene.add(self._on_gpu(mesh), pose=pose)
        self._offscreen.viewport_width = camera.width
        self._offscreen.viewport_height = camera.height
        flags = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.SKIP_CULL_FACES
        rgba, depth = self._offscreen.render(scene, flags)
        rgb = cv2.cvtColor(rgba, cv2.COLOR_RGBA2RGB).astype(np.uint8, copy=False)
        shown = np.where(rgba[..., 3] > 0, depth, np.float32(0))
        return RenderedView(rgb, shown, world_from_camera, camera)

    def close(self) -> None:
        """Release the context."""
        self._meshes.clear()
        self._offscreen.delete()
        self._shaders.cleanup()

    def _on_gpu(self, mesh: TileMesh) -> Any:
        key = id(mesh.positions)  # shared by copies elsewhere, see `TileMesh.placed`
        if key not in self._meshes:
            self._meshes[key] = (mesh, _pyrender_mesh(mesh))
            if len(self._meshes) > _KEPT_MESHES:
                _, (_, old) = self._meshes.popitem(last=False)
                del old  # pyrender frees what no scene shows any more
        self._meshes.move_to_end(key)
        return self._meshes[key][1]


def _pyrender_mesh(mesh: TileMesh) -> Any:
    # RGBA: pyrender leaves OpenGL's row alignment of 4 bytes as it is.
    rgba = cv2.cvtColor(np.ascontiguousarray(mesh.mips[0]), cv2.COLOR_RGB2RGBA)
    wrap = _REPEAT if mesh.repeat else _CLAMP_TO_EDGE
    sampler = pyrender.Sampler(
        magFilter=_LINEAR, minFilter=_LINEAR_MIPMAP_NEAREST, wrapS=wrap, wrapT=wrap
    )
    texture = pyrender.Texture(source=rgba, source_channels="RGBA", sampler=sampler)
    material = pyrender.MetallicRoughnessMaterial(
        baseColorTexture=texture, roughnessFactor=len(mesh.mips) / 32, doubleSided=True
    )
    uvs = np.column_stack([mesh.uvs[:, 0], 1 - mesh.uvs[:, 1]])  # v upwards there
    primitive = pyrender.Primitive(
        positions=mesh.positions, texcoord_0=uvs, indices=mesh.faces, material=material, mode=4
    )
    return pyrender.Mesh([primitive])


class _Projection(pyrender.Camera):
    """A pyrender camera of OpenCV axes; image row 0 is the framebuffer's row 0."""

    def __init__(self, camera: Camera) -> None:
        super().__init__()
        self._matrix = clip_from_camera(camera)

    def get_projection_matrix(self, width: int | None = None, height: int | None = None) -> Array:
        """(4, 4); the size is the camera's."""
        del width, height
        return self._matrix


class _ExactRenderer(Renderer):
    """pyrender's renderer with a framebuffer of RGBA bytes and float32 depth, one sample each."""

    def __init__(self, width: int, height: int, shaders: str) -> None:
        super().__init__(width, height)
        self._main_fb: Any
        self._main_fb_dims: tuple[Any, Any]
        self._program_cache = ShaderProgramCache(shader_dir=shaders)
        self._textures: list[int] = []

    def _configure_main_framebuffer(self) -> None:
        size = (self.viewport_width, self.viewport_height)
        if self._main_fb is not None and size == self._main_fb_dims:
            return
        self._delete_main_framebuffer()
        self._main_fb = GL.glGenFramebuffers(1)
        self._main_fb_ms = self._main_fb  # what the forward pass draws to
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._main_fb)
        targets = []
        for i, (inner, outer, kind) in enumerate(
            [
                (GL.GL_RGBA8, GL.GL_RGBA, GL.GL_UNSIGNED_BYTE),
                (GL.GL_R32F, GL.GL_RED, GL.GL_FLOAT),
            ]
        ):
            texture = GL.glGenTextures(1)
            self._textures.append(texture)
            GL.glBindTexture(GL.GL_TEXTURE_2D, texture)
            GL.glTexImage2D(GL.GL_TEXTURE_2D, 0, inner, *size, 0, outer, kind, None)
            GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_MIN_FILTER, GL.GL_NEAREST)
            targets.append(GL.GL_COLOR_ATTACHMENT0 + i)
            GL.glFramebufferTexture2D(GL.GL_FRAMEBUFFER, targets[-1], GL.GL_TEXTURE_2D, texture, 0)
        self._main_db = GL.glGenRenderbuffers(1)
        GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, self._main_db)
        GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, GL.GL_DEPTH_COMPONENT32F, *size)
        GL.glFramebufferRenderbuffer(
            GL.GL_FRAMEBUFFER, GL.GL_DEPTH_ATTACHMENT, GL.GL_RENDERBUFFER, self._main_db
        )
        GL.glDrawBuffers(len(targets), targets)
        GL.glBindTexture(GL.GL_TEXTURE_2D, 0)
        self._main_fb_dims = size

    def _delete_main_framebuffer(self) -> None:
        if self._main_fb is not None:
            GL.glDeleteFramebuffers(1, [self._main_fb])
            GL.glDeleteRenderbuffers(1, [self._main_db])
            GL.glDeleteTextures(self._textures)
        self._textures = []
        self._main_fb = self._main_fb_ms = self._main_db = None
        self._main_fb_dims = (None, None)

    def _read_main_framebuffer(self, scene: Any, flags: int) -> tuple[Any, Any]:
        del scene, flags
        width, height = self._main_fb_dims
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb)
        rgba = np.empty((height, width, 4), np.uint8)
        depth = np.empty((height, width), np.float32)
        for i, (form, kind, out) in enumerate(
            [(GL.GL_RGBA, GL.GL_UNSIGNED_BYTE, rgba), (GL.GL_RED, GL.GL_FLOAT, depth)]
        ):
            GL.glReadBuffer(GL.GL_COLOR_ATTACHMENT0 + i)
            GL.glReadPixels(0, 0, width, height, form, kind, out)
        return rgba, depth
