//! The camera: RGB images from an off-screen OpenGL context without a window.

use std::cell::OnceCell;
use std::ffi::{CStr, c_char, c_void};
use std::rc::Rc;
use std::sync::Arc;

use bytes::Bytes;
use khronos_egl as egl;
use mujoco_rs::prelude::*;
use protocol::Image;

use crate::fault::Fault;

type Egl = egl::DynamicInstance<egl::EGL1_5>;

/// An environment variable and its value: Mesa's software renderer renders in the calling thread.
/// Passing a small image to its own threads takes as long as rendering it, and servers use several
/// processes for parallelism.
pub const DRAWING_THREADS: (&str, &str) = ("LP_NUM_THREADS", "0");
const GEOMS_MAX: usize = 200;
/// Margin for rounding, in metres.
const EDGE_MARGIN: f32 = 1e-3;
/// From EGL_EXT_platform_device: a display of a graphics device, without a window system.
const PLATFORM_DEVICE: egl::Enum = 0x313F;
const DEVICES_MAX: usize = 16;
/// From EGL_EXT_device_query: the query for a device's extensions, and the extension of Mesa's
/// software renderer.
const EXTENSIONS: egl::Int = 0x3055;
const SOFTWARE_DEVICE: &[u8] = b"EGL_MESA_device_software";

/// One fixed camera. Its field of view is set by the model and not by the image's shape. With 0 x 0
/// pixels it renders nothing and needs no OpenGL. Use it only in the thread that created it.
pub struct Camera(Option<Renderer>);

struct Renderer {
    /// Freed before its OpenGL context.
    context: Option<MjrContext>,
    scene: MjvScene,
    option: MjvOption,
    view: MjvCamera,
    rectangle: MjrRectangle,
    offscreen: Offscreen,
}

/// An OpenGL context that renders into MuJoCo's buffer.
struct Offscreen {
    display: Rc<Display>,
    context: egl::Context,
}

/// libEGL and the display of Mesa's software device, or of the first working device if there is
/// none. All cameras of a thread share it.
struct Display {
    egl: Egl,
    display: egl::Display,
}

impl Camera {
    pub fn new(
        model: &Arc<MjModel>,
        camera: usize,
        height: u32,
        width: u32,
    ) -> Result<Camera, Fault> {
        let is_wanted = (height, width) != (0, 0);
        let renderer = is_wanted.then(|| Renderer::new(model, camera, height, width));
        Ok(Camera(renderer.transpose()?))
    }

    /// Renders the current state.
    pub fn image(&mut self, data: &mut MjData<Arc<MjModel>>) -> Result<Image, Fault> {
        match &mut self.0 {
            Some(renderer) => renderer.image(data),
            None => Ok(Image { height: 0, width: 0, pixels: Bytes::new() }),
        }
    }
}

impl Renderer {
    fn new(
        model: &Arc<MjModel>,
        camera: usize,
        height: u32,
        width: u32,
    ) -> Result<Renderer, Fault> {
        let offscreen = Offscreen::new().map_err(|error| {
            Fault::RendererUnavailable(format!(
                "renderer for {height} x {width} images: expected an offscreen OpenGL context, got {error}"
            ))
        })?;
        // SAFETY: `Offscreen::new` has made its context current in this thread.
        let mut context = unsafe { MjrContext::new(model) };
        context.resize_offscreen(width, height);
        context.offscreen();
        let mut scene = MjvScene::new(Arc::clone(model), GEOMS_MAX);
        // SAFETY: flags are plain numbers that MuJoCo reads when it renders.
        let flags = unsafe { &mut scene.ffi_mut().flags };
        for flag in [MjtRndFlag::mjRND_SHADOW, MjtRndFlag::mjRND_REFLECTION] {
            flags[flag as usize] = 0;
        }
        Ok(Renderer {
            context: Some(context),
            scene,
            option: MjvOption::default(),
            view: MjvCamera::new_fixed(camera),
            rectangle: MjrRectangle {
                left: 0,
                bottom: 0,
                width: width as i32,
                height: height as i32,
            },
            offscreen,
        })
    }

    fn image(&mut self, data: &mut MjData<Arc<MjModel>>) -> Result<Image, Fault> {
        // A process may have several environments: each one makes its own context current first.
        self.offscreen.make_current().map_err(Fault::RendererUnavailable)?;
        let Some(context) = &self.context else {
            return Err(Fault::RendererUnavailable("the renderer was freed".to_owned()));
        };
        self.scene.update(data, &self.option, &MjvPerturb::default(), &mut self.view);
        keep_inside(&mut self.scene);
        self.scene.render(&self.rectangle, context);
        let (height, width) = (self.rectangle.height as usize, self.rectangle.width as usize);
        let row = width * 3;
        let mut upwards = vec![0; height * row];
        context
            .read_pixels(Some(&mut upwards), None, &self.rectangle)
            .map_err(|error| Fault::RendererUnavailable(error.to_string()))?;
        // OpenGL's rows start at the bottom.
        let mut pixels = Vec::with_capacity(upwards.len());
        upwards.chunks_exact(row).rev().for_each(|line| pixels.extend_from_slice(line));
        Ok(Image { height, width, pixels: pixels.into() })
    }
}

/// Removes shapes outside the image from the scene. This changes no pixel and saves OpenGL work.
fn keep_inside(scene: &mut MjvScene) {
    // SAFETY: this only reorders the shapes and reduces their count.
    let scene = unsafe { scene.ffi_mut() };
    let [left_eye, right_eye] = &scene.camera;
    let camera = left_eye;
    // MuJoCo renders from the midpoint between the eyes unless the image is stereoscopic.
    let position: [f32; 3] =
        std::array::from_fn(|axis| f32::midpoint(left_eye.pos[axis], right_eye.pos[axis]));
    let (forward, up) = (camera.forward, camera.up);
    let right = [
        forward[1] * up[2] - forward[2] * up[1],
        forward[2] * up[0] - forward[0] * up[2],
        forward[0] * up[1] - forward[1] * up[0],
    ];
    let dot = |left: [f32; 3], right: [f32; 3]| -> f32 {
        left.iter().zip(right).map(|(left, right)| left * right).sum()
    };
    // Half of the image's width and height at a distance of 1 m.
    let wide = camera.frustum_width / camera.frustum_near;
    let high = camera.frustum_top / camera.frustum_near;
    let is_outside = |geom: &mujoco_rs::mujoco_c::mjvGeom| {
        let offset = std::array::from_fn(|axis| geom.pos[axis] - position[axis]);
        let depth = dot(offset, forward);
        let beyond = |across: f32, slope: f32| (across.abs() - slope * depth) / slope.hypot(1.0);
        let beyond = [beyond(dot(offset, right), wide), beyond(dot(offset, up), high), -depth];
        // A bounding radius of 0 means an infinite shape.
        let radius = geom.modelrbound;
        radius > 0.0 && beyond.iter().any(|distance| *distance > radius + EDGE_MARGIN)
    };
    // SAFETY: MuJoCo has filled this number of shapes, and nothing else uses them now.
    let geoms = unsafe { std::slice::from_raw_parts_mut(scene.geoms, scene.ngeom as usize) };
    let mut kept = 0;
    for index in 0..geoms.len() {
        if !is_outside(&geoms[index]) {
            geoms.swap(kept, index);
            kept += 1;
        }
    }
    scene.ngeom = kept as i32;
}

impl Drop for Renderer {
    fn drop(&mut self) {
        // Freeing without its own context current would free another camera's buffers.
        if self.offscreen.make_current().is_ok() {
            self.context.take();
        } else {
            std::mem::forget(self.context.take());
        }
    }
}

impl Offscreen {
    /// Creates a context and makes it current.
    fn new() -> Result<Offscreen, String> {
        let shared = Display::of_this_thread()?;
        let Display { egl, display } = &*shared;
        let wanted = [
            (egl::RED_SIZE, 8),
            (egl::GREEN_SIZE, 8),
            (egl::BLUE_SIZE, 8),
            (egl::ALPHA_SIZE, 8),
            (egl::DEPTH_SIZE, 24),
            (egl::STENCIL_SIZE, 8),
            (egl::COLOR_BUFFER_TYPE, egl::RGB_BUFFER),
            (egl::SURFACE_TYPE, egl::PBUFFER_BIT),
            (egl::RENDERABLE_TYPE, egl::OPENGL_BIT),
        ];
        let mut attributes: Vec<egl::Int> =
            wanted.into_iter().flat_map(|(name, value)| [name, value]).collect();
        attributes.push(egl::NONE);
        let words = |error: egl::Error| error.to_string();
        let config = egl.choose_first_config(*display, &attributes).map_err(words)?;
        let config = config.ok_or("no configuration with 8-bit colours and a 24-bit depth")?;
        egl.bind_api(egl::OPENGL_API).map_err(words)?;
        let context = egl.create_context(*display, config, None, &[egl::NONE]).map_err(words)?;
        let offscreen = Offscreen { display: Rc::clone(&shared), context };
        offscreen.make_current()?;
        Ok(offscreen)
    }

    fn make_current(&self) -> Result<(), String> {
        let Display { egl, display } = &*self.display;
        egl.make_current(*display, None, None, Some(self.context))
            .map_err(|error| error.to_string())
    }
}

impl Drop for Offscreen {
    fn drop(&mut self) {
        let Display { egl, display } = &*self.display;
        // A context that cannot be freed is freed with the process.
        let _ = egl.make_current(*display, None, None, None);
        let _ = egl.destroy_context(*display, self.context);
    }
}

impl Display {
    fn of_this_thread() -> Result<Rc<Display>, String> {
        thread_local! {
            static DISPLAY: OnceCell<Rc<Display>> = const { OnceCell::new() };
        }
        DISPLAY.with(|known| match known.get() {
            Some(display) => Ok(Rc::clone(display)),
            None => {
                let display = Rc::new(Display::open()?);
                Ok(Rc::clone(known.get_or_init(|| display)))
            }
        })
    }

    fn open() -> Result<Display, String> {
        // SAFETY: loading libEGL runs its initialisers, as intended.
        let egl = unsafe { Egl::load_required() }
            .map_err(|error| format!("cannot load libEGL.so.1 with EGL 1.5: {error}"))?;
        let mut devices = devices(&egl)?;
        // Images must not depend on the machine's GPU.
        devices.sort_by_key(|device| !is_software(&egl, *device));
        let mut reason = "found no EGL device".to_owned();
        for device in devices {
            // SAFETY: the device was listed by this library.
            let display =
                unsafe { egl.get_platform_display(PLATFORM_DEVICE, device, &[egl::ATTRIB_NONE]) };
            match display.and_then(|display| egl.initialize(display).map(|_| display)) {
                Ok(display) => return Ok(Display { egl, display }),
                Err(error) => reason = error.to_string(),
            }
        }
        Err(format!("cannot open a display of an EGL device: {reason}"))
    }
}

fn devices(egl: &Egl) -> Result<Vec<*mut c_void>, String> {
    type QueryDevices =
        unsafe extern "system" fn(egl::Int, *mut *mut c_void, *mut egl::Int) -> egl::Boolean;
    let query = egl
        .get_proc_address("eglQueryDevicesEXT")
        .ok_or("libEGL has no eglQueryDevicesEXT: expected EGL_EXT_device_enumeration")?;
    // SAFETY: EGL_EXT_device_enumeration defines this function with this type.
    let query: QueryDevices = unsafe { std::mem::transmute(query) };
    let mut devices = vec![std::ptr::null_mut(); DEVICES_MAX];
    let mut count = 0;
    // SAFETY: there is room for DEVICES_MAX devices.
    let done = unsafe { query(DEVICES_MAX as egl::Int, devices.as_mut_ptr(), &mut count) };
    if done != egl::TRUE {
        return Err("eglQueryDevicesEXT failed".to_owned());
    }
    devices.truncate(count as usize);
    Ok(devices)
}

fn is_software(egl: &Egl, device: *mut c_void) -> bool {
    type QueryString = unsafe extern "system" fn(*mut c_void, egl::Int) -> *const c_char;
    let Some(query) = egl.get_proc_address("eglQueryDeviceStringEXT") else { return false };
    // SAFETY: EGL_EXT_device_query defines this function with this type.
    let query: QueryString = unsafe { std::mem::transmute(query) };
    // SAFETY: the device was listed by this library.
    let extensions = unsafe { query(device, EXTENSIONS) };
    if extensions.is_null() {
        return false;
    }
    // SAFETY: EGL returns a zero-terminated text that lives as long as the library.
    let extensions = unsafe { CStr::from_ptr(extensions) };
    extensions.to_bytes().split(|byte| *byte == b' ').any(|name| name == SOFTWARE_DEVICE)
}
