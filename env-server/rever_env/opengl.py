"""Offscreen OpenGL contexts on Linux without a window: EGL on Mesa's software device.

This module chooses the device, independently of environment variables and displays, so that images
are the same on every machine and in every process.
"""

import ctypes
import json
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from rever_env.fault import RendererUnavailable

HAS_EGL = sys.platform == "linux"  # elsewhere MuJoCo's own contexts are used
_PACKAGES = "libegl1, libopengl0 and libgl1-mesa-dri"  # Debian and Ubuntu
_DEVICES_MAX = 16
# Values of the EGL 1.5 headers.
_PLATFORM_DEVICE, _EXTENSIONS, _OPENGL_API, _DRAW, _READ = 0x313F, 0x3055, 0x30A2, 0x3059, 0x305A
_SOFTWARE_DEVICE = b"EGL_MESA_device_software"
_CONFIGURATION = (
    (0x3024, 8),  # red bits
    (0x3023, 8),  # green bits
    (0x3022, 8),  # blue bits
    (0x3021, 8),  # alpha bits
    (0x3025, 24),  # depth bits
    (0x3026, 8),  # stencil bits
    (0x303F, 0x308E),  # RGB
    (0x3033, 1),  # offscreen
    (0x3040, 8),  # OpenGL
)
_END = 0x3038
# Environment variables that choose another driver or device.
_DRIVER_CHOICES = ("EGL_PLATFORM", "GALLIUM_DRIVER", "MESA_LOADER_DRIVER_OVERRIDE")
_VENDOR_FILES, _VENDOR_FOLDERS = "__EGL_VENDOR_LIBRARY_FILENAMES", "__EGL_VENDOR_LIBRARY_DIRS"
_Pointer = ctypes.c_void_p
_Current = tuple[int | None, int | None, int | None, int | None]
_lock = threading.Lock()


class Context:
    """An OpenGL context that is current only inside `with context.current()`, in any thread."""

    def __init__(self) -> None:
        with _lock:
            self._display = _display()
            self._handle = self._display.context()

    @contextmanager
    def current(self) -> Iterator[None]:
        """Makes the context current in this thread; restores the previous one afterwards."""
        egl = self._display.library
        before = _current(egl)
        self._display.make_current(self._handle)
        try:
            yield
        finally:
            egl.eglMakeCurrent(*(before or self._display.nothing))

    def free(self) -> None:
        """Frees the context; it must not be current."""
        self._display.library.eglDestroyContext(self._display.handle, self._handle)


@contextmanager
def preserved_context() -> Iterator[None]:
    """Restores this thread's current context after code that makes its own contexts current.

    A context that stays current in one thread cannot be used in another.
    """
    try:
        egl = _library()
    except RendererUnavailable:
        yield  # no EGL: such code renders in another way
        return
    before = _current(egl)
    try:
        yield
    finally:
        display = egl.eglGetCurrentDisplay()
        if before is not None:
            egl.eglMakeCurrent(*before)
        elif display is not None:
            egl.eglMakeCurrent(display, None, None, None)


def unavailable() -> str | None:
    """Why this process cannot render images; None if it can."""
    try:
        if HAS_EGL:
            Context().free()
    except RendererUnavailable as error:
        return str(error)
    return None


def choose_device_for_other_libraries() -> None:
    """Makes the renderers of MuJoCo, robosuite and Gymnasium use the device of this module.

    They read the environment variables on import or when they first render.
    """
    if not HAS_EGL:
        return
    os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = "egl"
    with _lock:
        os.environ["MUJOCO_EGL_DEVICE_ID"] = str(_display().device)


def isolate_process() -> list[str]:
    """Removes environment variables of this process that would choose another renderer.

    For the command line, before OpenGL is loaded. Returns warnings for the user.
    """
    if not HAS_EGL:
        return []
    for name in (*_DRIVER_CHOICES, "MUJOCO_EGL_DEVICE_ID"):
        os.environ.pop(name, None)
    os.environ["LIBGL_ALWAYS_SOFTWARE"] = "1"
    warnings = []
    for name in (_VENDOR_FILES, _VENDOR_FOLDERS):
        given = os.environ.get(name)
        if given is not None and not _names_mesa(name, given):
            del os.environ[name]
            warnings.append(f"ignored {name}={given}: expected a library of Mesa")
    os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = "egl"
    try:
        _library()
    except RendererUnavailable:
        os.environ["MUJOCO_GL"] = "disable"  # otherwise the import of MuJoCo would fail
    return warnings


def _names_mesa(variable: str, value: str) -> bool:
    """Whether these EGL vendor files, or one in these folders, load Mesa's library."""
    paths = [Path(path) for path in value.split(":") if path]
    if variable == _VENDOR_FOLDERS:
        paths = [file for folder in paths for file in folder.glob("*.json")]
    for path in paths:
        try:
            if "mesa" in json.loads(path.read_text())["ICD"]["library_path"].lower():
                return True
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue  # EGL ignores such a file, too
    return False


class _Display:
    """The EGL display of one device. device: its index among all devices."""

    def __init__(self) -> None:
        self.library = egl = _library()
        devices = _devices(egl)
        is_software = [_is_software(egl, device) for device in devices]
        # Fall back to any other device if there is no software device of Mesa.
        for index in sorted(range(len(devices)), key=lambda index: not is_software[index]):
            display = egl.eglGetPlatformDisplay(_PLATFORM_DEVICE, devices[index], None)
            if display is not None and egl.eglInitialize(display, None, None):
                self.handle, self.device = display, index
                break
        else:
            raise RendererUnavailable(
                f"none of {len(devices)} EGL devices works (install the Debian packages {_PACKAGES}"
                f"{_set_variables()})"
            )
        attributes = [number for pair in _CONFIGURATION for number in pair] + [_END]
        configuration, count = _Pointer(), ctypes.c_int()
        found = egl.eglChooseConfig(
            self.handle,
            (ctypes.c_int * len(attributes))(*attributes),
            ctypes.byref(configuration),
            1,
            ctypes.byref(count),
        )
        if not found or count.value < 1:
            raise RendererUnavailable("EGL has no configuration with 8-bit colours, 24-bit depth")
        self._configuration = configuration
        self.nothing: _Current = (self.handle, None, None, None)

    def context(self) -> int:
        egl = self.library
        egl.eglBindAPI(_OPENGL_API)
        context: int | None = egl.eglCreateContext(self.handle, self._configuration, None, None)
        if context is None:
            raise RendererUnavailable(f"EGL cannot create a context: error {_error(egl)}")
        return context

    def make_current(self, context: int) -> None:
        egl = self.library
        if not egl.eglMakeCurrent(self.handle, None, None, context):
            raise RendererUnavailable(
                f"EGL cannot make the context current in thread {threading.current_thread().name}: "
                f"error {_error(egl)}; is it current in another thread, or is a window's context "
                "current in this one?"
            )


@cache
def _display() -> _Display:
    return _Display()


@cache
def _library() -> ctypes.CDLL:
    try:
        # RTLD_GLOBAL: MuJoCo searches the process's symbols for EGL.
        egl = ctypes.CDLL("libEGL.so.1", mode=ctypes.RTLD_GLOBAL)
        declared = {
            "eglGetProcAddress": (_Pointer, ctypes.c_char_p),
            "eglGetPlatformDisplay": (_Pointer, ctypes.c_uint, _Pointer, _Pointer),
            "eglInitialize": (ctypes.c_uint, _Pointer, _Pointer, _Pointer),
            "eglChooseConfig": (ctypes.c_uint, *[_Pointer] * 3, ctypes.c_int, _Pointer),
            "eglBindAPI": (ctypes.c_uint, ctypes.c_uint),
            "eglCreateContext": (_Pointer, *[_Pointer] * 4),
            "eglDestroyContext": (ctypes.c_uint, _Pointer, _Pointer),
            "eglMakeCurrent": (ctypes.c_uint, *[_Pointer] * 4),
            "eglGetCurrentContext": (_Pointer,),
            "eglGetCurrentDisplay": (_Pointer,),
            "eglGetCurrentSurface": (_Pointer, ctypes.c_int),
            "eglGetError": (ctypes.c_int,),
        }
        for name, (result, *parameters) in declared.items():
            function = getattr(egl, name)
            function.restype, function.argtypes = result, parameters
    except (OSError, AttributeError) as error:
        raise RendererUnavailable(
            f"expected libEGL.so.1 with EGL 1.5: {error} (install the Debian packages {_PACKAGES})"
        ) from error
    return egl


def _devices(egl: ctypes.CDLL) -> list[int]:
    address = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    if address is None:
        raise RendererUnavailable("libEGL has no eglQueryDevicesEXT")
    query = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, _Pointer, _Pointer)(address)
    devices, count = (_Pointer * _DEVICES_MAX)(), ctypes.c_int()
    if not query(_DEVICES_MAX, devices, ctypes.addressof(count)):
        raise RendererUnavailable(f"eglQueryDevicesEXT failed{_set_variables()}")
    return [device for device in devices[: count.value] if device is not None]


def _is_software(egl: ctypes.CDLL, device: int) -> bool:
    address = egl.eglGetProcAddress(b"eglQueryDeviceStringEXT")
    if address is None:
        return False
    query = ctypes.CFUNCTYPE(ctypes.c_char_p, _Pointer, ctypes.c_int)(address)
    return _SOFTWARE_DEVICE in (query(device, _EXTENSIONS) or b"").split()


def _current(egl: ctypes.CDLL) -> _Current | None:
    """What is current in this thread: display, draw surface, read surface, context."""
    context = egl.eglGetCurrentContext()
    if context is None:
        return None
    draw, read = egl.eglGetCurrentSurface(_DRAW), egl.eglGetCurrentSurface(_READ)
    return egl.eglGetCurrentDisplay(), draw, read, context


def _error(egl: ctypes.CDLL) -> str:
    return f"0x{egl.eglGetError():X}"


def _set_variables() -> str:
    """The environment variables that may be the cause, with their values."""
    names = (_VENDOR_FILES, _VENDOR_FOLDERS, *_DRIVER_CHOICES)
    return "".join(f", {name}={os.environ[name]}" for name in names if name in os.environ)
