"""The camera: RGB images and visible-pixel masks from an offscreen OpenGL context."""

import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from rever_env import opengl
from rever_env.fault import RendererUnavailable

Image = NDArray[np.uint8]
_GEOMS_MAX = 200
_HIDDEN_GROUP = 5  # of shapes; MuJoCo draws the groups 0 to 2
_EDGE_MARGIN = 1e-3  # metres, for rounding errors of OpenGL


class Camera:
    """Renders one fixed camera; the model, not the image's shape, sets its field of view.

    With 0 x 0 pixels it renders nothing and needs no OpenGL. Any thread may use it, one at a time:
    its OpenGL context is current only while it renders.
    """

    def __init__(self, model: mujoco.MjModel, name: str, height: int, width: int) -> None:
        self._model = model
        self._height = height
        self._width = width
        self._view = mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._view.fixedcamid = model.camera(name).id
        if (height, width) != (0, 0):
            self._open(model, height, width)

    def _open(self, model: mujoco.MjModel, height: int, width: int) -> None:
        try:
            context = opengl.Context() if opengl.HAS_EGL else _PlatformContext(height, width)
            with context.current():
                renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50)
                mujoco.mjr_resizeOffscreen(width, height, renderer)
                mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, renderer)
        except Exception as error:  # MuJoCo raises errors of several types
            raise RendererUnavailable(
                f"renderer for {height} x {width} images: expected an offscreen OpenGL context, "
                f"got {error}"
            ) from error
        self._context, self._renderer = context, renderer
        self._release = weakref.finalize(self, _release, context, renderer)
        # Not at exit: the process frees it anyway, and MuJoCo may have closed the display already.
        self._release.atexit = False
        self._scene = mujoco.MjvScene(model, maxgeom=_GEOMS_MAX)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = 0
        self._option = mujoco.MjvOption()
        self._rectangle = mujoco.MjrRect(0, 0, width, height)
        self._upwards = np.empty((height, width, 3), dtype=np.uint8)
        self._groups = model.geom_group.copy()
        self._edges = _edges(model, self._view.fixedcamid)
        radii = model.geom_rbound[:, np.newaxis]  # (shapes, 1); 0: infinite
        self._radii = np.where(radii > 0.0, radii + _EDGE_MARGIN, np.inf)

    def image(self, data: mujoco.MjData) -> Image:
        """RGB, uint8 (height, width, 3)."""
        if self._height == 0:
            return np.empty((0, 0, 3), np.uint8)
        with self._context.current():
            self._update(data)
            return self._read()

    def bodies(self, data: mujoco.MjData) -> NDArray[np.int32]:
        """Body id at each pixel, int32 (height, width); -1 for the background."""
        flags = self._scene.flags
        with self._context.current():
            self._update(data)
            flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = 1
            flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 1
            pixels = self._read().astype(np.int32)
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = 0
        flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 0
        # Colour 0 is the background, colour k + 1 the scene's geom with segmentation id k.
        codes = pixels[..., 0] + 256 * pixels[..., 1] + 65536 * pixels[..., 2]
        body_of_code = np.full(self._scene.ngeom + 2, -1, dtype=np.int32)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.segid >= 0:
                body_of_code[geom.segid + 1] = self._model.geom_bodyid[geom.objid]
        seen: NDArray[np.int32] = body_of_code[codes]
        return seen

    def project(self, data: mujoco.MjData, point: NDArray[np.float64]) -> tuple[float, float]:
        """Image coordinates (x right, y down) of a world point, each 0 to 1 inside the image."""
        index = self._view.fixedcamid
        axes = data.cam_xmat[index].reshape(3, 3)
        local = axes.T @ (point - data.cam_xpos[index])
        depth = max(-float(local[2]), 1e-6)
        focal, sensor = self._model.cam_intrinsic[index], self._model.cam_sensorsize[index]
        x = 0.5 + float(focal[0]) * float(local[0]) / depth / float(sensor[0])
        y = 0.5 - float(focal[1]) * float(local[1]) / depth / float(sensor[1])
        return x, y

    def close(self) -> None:
        if self._height > 0:
            self._release()

    def __enter__(self) -> "Camera":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _update(self, data: mujoco.MjData) -> None:
        self._hide(data)
        mujoco.mjv_updateScene(
            self._model,
            data,
            self._option,
            None,
            self._view,
            mujoco.mjtCatBit.mjCAT_ALL,
            self._scene,
        )

    def _hide(self, data: mujoco.MjData) -> None:
        """Hides shapes outside the image, which OpenGL would process without changing a pixel."""
        index = self._view.fixedcamid
        normals = data.cam_xmat[index].reshape(3, 3) @ self._edges
        beyond = (data.geom_xpos - data.cam_xpos[index]) @ normals  # (shapes, 5), metres
        outside = (beyond > self._radii).any(axis=1)
        self._model.geom_group[:] = np.where(outside, _HIDDEN_GROUP, self._groups)

    def _read(self) -> Image:
        mujoco.mjr_render(self._rectangle, self._scene, self._renderer)
        mujoco.mjr_readPixels(self._upwards, None, self._rectangle, self._renderer)
        image: Image = self._upwards[::-1].copy()  # OpenGL's rows start at the bottom
        return image


def _edges(model: mujoco.MjModel, camera: int) -> NDArray[np.float64]:
    """Unit normals of the planes of the view, pointing outwards, (3, 5) in the camera's frame.

    Right, left, top, bottom and behind; the camera looks along -z with y up.
    """
    right, top = model.cam_sensorsize[camera] / (2.0 * model.cam_intrinsic[camera][:2])
    edges = np.array(
        [
            (1.0, 0.0, right),
            (-1.0, 0.0, right),
            (0.0, 1.0, top),
            (0.0, -1.0, top),
            (0.0, 0.0, 1.0),
        ]
    )
    normals: NDArray[np.float64] = (edges / np.linalg.norm(edges, axis=1, keepdims=True)).T
    return normals


class _PlatformContext:
    """MuJoCo's own context, for systems without EGL."""

    def __init__(self, height: int, width: int) -> None:
        self._context: Any = mujoco.GLContext(width, height)

    @contextmanager
    def current(self) -> Iterator[None]:
        self._context.make_current()
        yield

    def free(self) -> None:
        self._context.free()


def _release(context: opengl.Context | _PlatformContext, renderer: mujoco.MjrContext) -> None:
    with context.current():
        renderer.free()
    context.free()
