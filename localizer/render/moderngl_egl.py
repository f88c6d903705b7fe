"""GPU renderer: OpenGL 3.3 through EGL, no window (extra `gpu`).

Depth is the eye-space z written to a float32 target: a depth buffer's own values would have to be
turned back into metres. The context belongs to the thread that made it.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import moderngl
import numpy as np

from localizer.errors import RenderError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.cache.tile import TileMesh
from localizer.render.base import SKY, MapRenderer, TileProvider, clip_from_camera
from localizer.types import RenderedView

_EGL: dict[str, Any] = {"backend": "egl"}

_VERTEX_SHADER = """#version 330
uniform mat4 projection;
uniform mat3x4 camera_from_tile;  // rows of [R | t], composed in float64 on the CPU
in vec3 position;
in vec2 texture_coordinate;
out vec2 uv;
out float z;
void main() {
    vec3 p = vec4(position, 1.0) * camera_from_tile;
    uv = texture_coordinate;
    z = p.z;
    gl_Position = projection * vec4(p, 1.0);
}"""

# The mip is chosen by the footprint's area, as the CPU renderer does: level l where the pixel
# covers more than half a texel and at most two.
_FRAGMENT_SHADER = """#version 330
uniform sampler2D image;
uniform float levels;
in vec2 uv;
in float z;
layout(location = 0) out vec4 colour;
layout(location = 1) out float depth;
void main() {
    vec2 size = vec2(textureSize(image, 0));
    vec2 a = dFdx(uv) * size, b = dFdy(uv) * size;
    float area = abs(a.x * b.y - a.y * b.x);
    float level = clamp(ceil(0.5 * log2(max(area, 1e-9) * 0.5)), 0.0, levels - 1.0);
    colour = textureLod(image, uv, level);
    depth = z;
}"""


@dataclass(eq=False)
class _Uploaded:
    """A mesh on the GPU. owner: the mesh in memory, referenced so that its id is not reused."""

    owner: TileMesh
    array: Any
    buffers: tuple[Any, Any]
    texture: Any
    nbytes: int

    def release(self) -> None:
        for item in (self.array, *self.buffers, self.texture):
            item.release()


class ModernGLRenderer(MapRenderer):
    """Draws tiles with OpenGL. Only the thread that made it may use it."""

    def __init__(self, streamer: TileProvider, byte_budget: int = 1 << 30) -> None:
        """Open an EGL context; raises `RenderError` where there is none."""
        super().__init__(streamer)
        try:
            self._context: Any = moderngl.create_context(330, standalone=True, **_EGL)
        except Exception as error:  # moderngl and glcontext raise bare exceptions
            raise RenderError(f"no OpenGL 3.3 context through EGL: {error}") from error
        self.device = str(self._context.info["GL_RENDERER"])
        self.name = f"moderngl ({self.device})"
        self._owner = threading.get_ident()
        self._finish = _gl_finish()
        self._sky = tuple(c / 255 for c in SKY)
        self._budget = byte_budget
        self._program: Any = self._context.program(
            vertex_shader=_VERTEX_SHADER, fragment_shader=_FRAGMENT_SHADER
        )
        self._context.enable(moderngl.DEPTH_TEST)
        self._uploaded: OrderedDict[int, _Uploaded] = OrderedDict()  # least recent first
        self._bytes = 0
        self._targets: dict[tuple[int, int], tuple[Any, Any]] = {}  # by size: buffer, depth

    @property
    def is_software(self) -> bool:
        """Whether the driver draws on the CPU (llvmpipe), where the numba renderer is faster."""
        return any(name in self.device.lower() for name in ("llvmpipe", "softpipe", "swrast"))

    def draw(
        self, meshes: Sequence[TileMesh], world_from_camera: Pose, camera: Camera
    ) -> RenderedView:
        """Draw exactly these meshes. `RenderError` on a thread that did not make the renderer."""
        self._assert_owner()
        framebuffer, depths = self._target(camera.width, camera.height)
        framebuffer.use()
        framebuffer.clear(*self._sky, 0.0, depth=1.0)
        depths.write(np.zeros((camera.height, camera.width), np.float32))
        self._program["projection"].write(clip_from_camera(camera).T.astype("f4").tobytes())
        camera_from_world = world_from_camera.inverse
        for mesh in meshes:
            if len(mesh.faces) == 0:
                continue
            gpu = self._on_gpu(mesh)
            T = (camera_from_world @ mesh.world_from_tile).matrix[:3]
            self._program["camera_from_tile"].write(T.astype("f4").tobytes())
            self._program["levels"].value = float(len(mesh.mips))
            gpu.texture.use(0)
            gpu.array.render()
        self._finish()  # through ctypes: waits without the GIL, which reading back would hold
        rgba = np.empty((camera.height, camera.width, 4), np.uint8)
        depth = np.empty((camera.height, camera.width), np.float32)
        framebuffer.read_into(rgba, components=4, attachment=0)
        framebuffer.read_into(depth, components=1, attachment=1, dtype="f4")
        rgb = cv2.cvtColor(rgba, cv2.COLOR_RGBA2RGB).astype(np.uint8, copy=False)
        return RenderedView(rgb, depth, world_from_camera, camera)

    def close(self) -> None:
        """Release the OpenGL context and all uploaded meshes. Only the thread that made the
        renderer may call this.
        """
        self._assert_owner()
        for item in self._uploaded.values():
            item.release()
        self._uploaded.clear()
        self._context.release()

    def _assert_owner(self) -> None:
        # From another thread OpenGL would quietly return stale pixels.
        if threading.get_ident() != self._owner:
            raise RenderError("an OpenGL renderer was used by a thread that did not make it")

    def _target(self, width: int, height: int) -> tuple[Any, Any]:
        if (width, height) not in self._targets:
            colour = self._context.texture((width, height), 4, dtype="f1")
            depth = self._context.texture((width, height), 1, dtype="f4")
            buffer = self._context.depth_texture((width, height))
            framebuffer = self._context.framebuffer([colour, depth], buffer)
            self._targets[width, height] = framebuffer, depth
        return self._targets[width, height]

    def _on_gpu(self, mesh: TileMesh) -> _Uploaded:
        # Copies of a mesh elsewhere (`TileMesh.placed`) share their arrays, and so the upload.
        key = id(mesh.positions)
        if key in self._uploaded:
            self._uploaded.move_to_end(key)
            return self._uploaded[key]
        vertices = np.concatenate([mesh.positions, mesh.uvs], axis=1)
        points = self._context.buffer(np.ascontiguousarray(vertices, np.float32).tobytes())
        indices = self._context.buffer(np.ascontiguousarray(mesh.faces, np.int32).tobytes())
        layout = [(points, "3f 2f", "position", "texture_coordinate")]
        array = self._context.vertex_array(self._program, layout, indices)
        item = _Uploaded(mesh, array, (points, indices), self._texture(mesh), mesh.nbytes)
        self._uploaded[key] = item
        self._bytes += item.nbytes
        while self._bytes > self._budget and len(self._uploaded) > 1:
            _, old = self._uploaded.popitem(last=False)
            self._bytes -= old.nbytes
            old.release()
        return item

    def _texture(self, mesh: TileMesh) -> Any:
        height, width = mesh.mips[0].shape[:2]
        texture = self._context.texture((width, height), 3, mesh.mips[0].tobytes(), alignment=1)
        if len(mesh.mips) > 1:
            texture.build_mipmaps(0, len(mesh.mips) - 1)  # makes room; the prebuilt ones replace it
            for level, mip in enumerate(mesh.mips[1:], 1):
                texture.write(mip.tobytes(), level=level, alignment=1)
            texture.filter = (moderngl.LINEAR_MIPMAP_NEAREST, moderngl.LINEAR)
        else:
            texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
        texture.repeat_x = texture.repeat_y = mesh.repeat
        return texture


def _gl_finish() -> Any:
    for name in ("GL", "OpenGL", "GLESv2"):
        path = ctypes.util.find_library(name)
        if path is not None:
            finish = ctypes.CDLL(path).glFinish  # CDLL calls release the GIL
            finish.restype = None
            finish.argtypes = []
            return finish
    raise RenderError("no OpenGL library found (libGL, libOpenGL or libGLESv2)")
