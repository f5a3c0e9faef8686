//! EGL without a window: enumerates the devices of this machine and creates surfaceless OpenGL 4.3 core contexts.
//! Drivers may create a later version; `gl/clip_control.rs` needs 4.5 or an extension.
//!
//! Displays are initialized once and never terminated: EGL returns the same display of a device to all callers in a
//! process, so terminating it would invalidate the other renderers' contexts.

use std::cell::RefCell;
use std::ffi::{CStr, c_char, c_void};
use std::mem::ManuallyDrop;
use std::rc::{Rc, Weak};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

use khronos_egl as egl;

use modalcast_model::error::{Error, Result, fault, fault_in};

type Instance = egl::DynamicInstance<egl::EGL1_4>;
type EglHandle = *mut c_void;
type QueryDevices = unsafe extern "system" fn(i32, *mut EglHandle, *mut i32) -> u32;
type QueryAttribute = unsafe extern "system" fn(EglHandle, i32, *mut isize) -> u32;
type QueryString = unsafe extern "system" fn(EglHandle, i32) -> *const c_char;
type PlatformDisplay = unsafe extern "system" fn(u32, *mut c_void, *const i32) -> EglHandle;

/// EGL_PLATFORM_DEVICE_EXT.
const PLATFORM_DEVICE: u32 = 0x313F;
/// EGL_PLATFORM_SURFACELESS_MESA.
const PLATFORM_SURFACELESS: u32 = 0x31DD;
/// EGL_CUDA_DEVICE_NV.
const CUDA_DEVICE: i32 = 0x323A;
/// EGL_DRM_DEVICE_FILE_EXT.
const DRM_DEVICE_FILE: i32 = 0x3233;
/// EGL_DRIVER_NAME_EXT.
const DRIVER_NAME: i32 = 0x335E;
/// EGL_CONTEXT_FLAGS_KHR.
const CONTEXT_FLAGS: i32 = 0x30FC;
/// EGL_CONTEXT_OPENGL_DEBUG_BIT_KHR.
const DEBUG_BIT: i32 = 1;
/// What the user can do if EGL is missing.
const REMEDY: &str = "Install libegl1 with libegl-mesa0 and libgl1-mesa-dri (Mesa's software rasterizer), or the NVIDIA \
                      driver's libEGL_nvidia.so.0 with its vendor file 10_nvidia.json in /usr/share/glvnd/egl_vendor.d";

/// Serializes display queries and the creation and destruction of contexts, because these race in some drivers.
static CONTEXT_LOCK: Mutex<()> = Mutex::new(());

thread_local! {
    /// The context that is current on this thread; dangling if there is none or if the current context is unknown. It
    /// has no destructor, so that it is also valid while other thread-local values are dropped.
    static CURRENT_CONTEXT: ManuallyDrop<RefCell<Weak<ContextHandle>>> =
        const { ManuallyDrop::new(RefCell::new(Weak::new())) };
}

/// A display on which a context can be created.
#[derive(Debug, Clone)]
pub(crate) struct Candidate {
    /// Index among EGL's devices; `None` for Mesa's surfaceless platform.
    pub(crate) index: Option<usize>,
    /// Name of the vendor or driver.
    pub(crate) vendor: String,
    /// Extensions of the device.
    pub(crate) extensions: Vec<String>,
    /// Ordinal of the corresponding CUDA device.
    pub(crate) cuda_device: Option<i32>,
    /// DRM node, such as `/dev/dri/card0`.
    pub(crate) drm_node: Option<String>,
    /// Whether the device reports that it is a software renderer.
    pub(crate) software: bool,
    display: egl::Display,
}

/// A surfaceless OpenGL context. It is current while a guard of [`Self::make_current`] exists.
#[derive(Debug)]
pub(crate) struct Context {
    handle: Rc<ContextHandle>,
    /// Whether this is a debug context.
    pub(crate) is_debug: bool,
}

/// Keeps a context current on this thread. When the guard is dropped, also by a panic that unwinds, the previous
/// context becomes current again. If there was none, the context stays current, because releasing a context flushes its
/// commands.
#[derive(Debug)]
#[must_use = "the previous context becomes current again when the guard is dropped"]
pub(crate) struct CurrentContext {
    /// The context to restore; `None` if there is nothing to restore.
    previous: Option<Weak<ContextHandle>>,
}

/// An EGL context, which is destroyed when dropped.
#[derive(Debug)]
struct ContextHandle {
    display: egl::Display,
    context: egl::Context,
}

/// libEGL, and its extension functions; `None` if libEGL lacks a function.
struct EglApi {
    instance: Instance,
    query_devices: Option<QueryDevices>,
    query_attribute: Option<QueryAttribute>,
    query_string: Option<QueryString>,
    platform_display: Option<PlatformDisplay>,
}

fn unavailable(reason: impl Into<String>) -> Error {
    Error::Unavailable { what: "headless OpenGL (EGL)", reason: reason.into(), remedy: REMEDY.into() }
}

fn lock_contexts() -> MutexGuard<'static, ()> {
    // The lock guards no data, so a poisoned lock is safe to use.
    CONTEXT_LOCK.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Loads libEGL on the first call.
fn api() -> Result<&'static EglApi> {
    static API: OnceLock<Result<EglApi>> = OnceLock::new();
    API.get_or_init(EglApi::load).as_ref().map_err(Clone::clone)
}

impl EglApi {
    fn load() -> Result<Self> {
        // SAFETY: loading libEGL runs the initializers of libEGL and of its vendor libraries.
        let instance = unsafe { Instance::load_required_from_filename("libEGL.so.1") }
            .map_err(|error| unavailable(format!("libEGL.so.1 cannot be loaded ({error})")))?;
        let find_function = |name: &str| instance.get_proc_address(name);
        // SAFETY: the types are those of EGL_EXT_device_enumeration, EGL_EXT_device_query and EGL_EXT_platform_base.
        // EGL may return an address for an extension that it lacks; calling it then returns an error.
        let (query_devices, query_attribute, query_string, platform_display) = unsafe {
            (
                find_function("eglQueryDevicesEXT")
                    .map(|function| std::mem::transmute::<extern "system" fn(), QueryDevices>(function)),
                find_function("eglQueryDeviceAttribEXT")
                    .map(|function| std::mem::transmute::<extern "system" fn(), QueryAttribute>(function)),
                find_function("eglQueryDeviceStringEXT")
                    .map(|function| std::mem::transmute::<extern "system" fn(), QueryString>(function)),
                find_function("eglGetPlatformDisplayEXT")
                    .map(|function| std::mem::transmute::<extern "system" fn(), PlatformDisplay>(function)),
            )
        };
        Ok(Self { instance, query_devices, query_attribute, query_string, platform_display })
    }

    /// EGL's devices, at most 64.
    fn devices(&self) -> Vec<EglHandle> {
        let Some(query_devices) = self.query_devices else { return Vec::new() };
        let mut devices = [std::ptr::null_mut(); 64];
        let mut count = 0;
        // SAFETY: the array has capacity for the 64 handles that the call may write, and the count outlives the call.
        let status = unsafe { query_devices(devices.len() as i32, devices.as_mut_ptr(), &raw mut count) };
        let count = if status == 0 { 0 } else { usize::try_from(count).unwrap_or(0) };
        devices[..count.min(devices.len())].to_vec()
    }

    /// A string that EGL reports for a device.
    fn query_text(&self, device: EglHandle, name: i32) -> Option<String> {
        let query_string = self.query_string?;
        // SAFETY: the device came from eglQueryDevicesEXT; the result is null or a string that lives as long as EGL.
        unsafe {
            let text = query_string(device, name);
            (!text.is_null()).then(|| CStr::from_ptr(text).to_string_lossy().into_owned())
        }
    }

    /// Ordinal of the CUDA device that corresponds to an EGL device.
    fn cuda_device(&self, device: EglHandle) -> Option<i32> {
        let mut value = -1_isize;
        // SAFETY: the device came from eglQueryDevicesEXT and the value outlives the call.
        let status = unsafe { self.query_attribute?(device, CUDA_DEVICE, &raw mut value) };
        (status != 0).then(|| i32::try_from(value).ok()).flatten()
    }

    /// The display of a device, or of the surfaceless platform.
    fn display(&self, platform: u32, native_display: EglHandle) -> Option<egl::Display> {
        let empty_attributes = [egl::NONE];
        // SAFETY: `native_display` is a device of eglQueryDevicesEXT, or null for the surfaceless platform; NONE ends
        // the list.
        let display = unsafe { self.platform_display?(platform, native_display, empty_attributes.as_ptr()) };
        // SAFETY: EGL created the display, and this process never terminates it.
        (!display.is_null()).then(|| unsafe { egl::Display::from_ptr(display) })
    }

    /// Describes a device; `None` if it has no display.
    fn candidate(&self, index: usize, device: EglHandle) -> Option<Candidate> {
        let extensions: Vec<String> =
            self.query_text(device, egl::EXTENSIONS).unwrap_or_default().split_whitespace().map(String::from).collect();
        let has_extension = |name: &str| extensions.iter().any(|extension| extension == name);
        let drm_node = has_extension("EGL_EXT_device_drm").then(|| self.query_text(device, DRM_DEVICE_FILE)).flatten();
        let cuda_device = has_extension("EGL_NV_device_cuda").then(|| self.cuda_device(device)).flatten();
        let vendor_name =
            has_extension("EGL_EXT_device_query_name").then(|| self.query_text(device, egl::VENDOR)).flatten();
        let driver_name =
            has_extension("EGL_EXT_device_persistent_id").then(|| self.query_text(device, DRIVER_NAME)).flatten();
        let software = has_extension("EGL_MESA_device_software");
        let display = self.display(PLATFORM_DEVICE, device)?;
        let vendor = vendor_name
            .or(driver_name)
            .unwrap_or_else(|| if software { "Mesa software".into() } else { "unnamed".into() });
        Some(Candidate {
            index: Some(index),
            vendor,
            cuda_device,
            drm_node: drm_node.filter(|node| !node.is_empty()),
            software,
            extensions,
            display,
        })
    }
}

/// All displays on which a context can be created: EGL's devices in their order, then Mesa's surfaceless platform.
///
/// # Errors
/// `Unavailable` when libEGL cannot be loaded.
pub(crate) fn candidates() -> Result<Vec<Candidate>> {
    let api = api()?;
    let _lock = lock_contexts();
    let mut candidates: Vec<Candidate> =
        api.devices().into_iter().enumerate().filter_map(|(index, device)| api.candidate(index, device)).collect();
    let surfaceless = api.display(PLATFORM_SURFACELESS, std::ptr::null_mut());
    candidates.extend(surfaceless.map(|display| Candidate {
        index: None,
        vendor: "Mesa surfaceless".into(),
        extensions: Vec::new(),
        cuda_device: None,
        drm_node: None,
        software: false,
        display,
    }));
    Ok(candidates)
}

/// The error if no candidate is suitable. `attempts` describe the candidates that were tried.
pub(crate) fn no_device_error(expected: &str, attempts: &[String]) -> Error {
    let attempts = if attempts.is_empty() { "EGL has no device".to_string() } else { attempts.join("; ") };
    unavailable(format!("no context on {expected}: {attempts}"))
}

impl Context {
    /// Creates a context on a candidate. A debug context reports more and can be slower.
    ///
    /// # Errors
    /// `Unavailable` without libEGL; `Fault` when EGL cannot create the context.
    pub(crate) fn open(candidate: &Candidate, is_debug: bool) -> Result<Self> {
        let instance = &api()?.instance;
        let display = candidate.display;
        let to_fault = fault_in::<egl::Error>("EGL context");
        #[cfg(test)]
        testing::wait_for_other_tests();
        let _lock = lock_contexts();
        instance.initialize(display).map_err(fault_in("EGL initialize"))?;
        let extensions = instance.query_string(Some(display), egl::EXTENSIONS).map_err(&to_fault)?.to_string_lossy();
        if !extensions.contains("EGL_KHR_surfaceless_context") {
            return Err(fault("EGL context", "expected the extension EGL_KHR_surfaceless_context"));
        }
        instance.bind_api(egl::OPENGL_API).map_err(&to_fault)?;
        let config = choose_config(instance, display)?;
        let attributes = [
            egl::CONTEXT_MAJOR_VERSION,
            4,
            egl::CONTEXT_MINOR_VERSION,
            3,
            egl::CONTEXT_OPENGL_PROFILE_MASK,
            egl::CONTEXT_OPENGL_CORE_PROFILE_BIT,
            // NONE ends the list, so the bit after it is not read.
            if is_debug { CONTEXT_FLAGS } else { egl::NONE },
            DEBUG_BIT,
            egl::NONE,
        ];
        let context = instance.create_context(display, config, None, &attributes).map_err(&to_fault)?;
        Ok(Self { handle: Rc::new(ContextHandle { display, context }), is_debug })
    }

    /// Makes the context current on this thread.
    ///
    /// # Errors
    /// `Fault` when EGL fails, for example because the context is current on another thread. No command of this context
    /// may be issued then.
    pub(crate) fn make_current(&self) -> Result<CurrentContext> {
        let previous = CURRENT_CONTEXT.with(|current| current.borrow().clone());
        if std::ptr::eq(previous.as_ptr(), Rc::as_ptr(&self.handle)) {
            return Ok(CurrentContext { previous: None });
        }
        self.handle.bind()?;
        Ok(CurrentContext { previous: (previous.strong_count() > 0).then_some(previous) })
    }

    /// Address of an OpenGL function, or null.
    pub(crate) fn address(&self, name: &str) -> *const c_void {
        let function = api().ok().and_then(|api| api.instance.get_proc_address(name));
        function.map_or(std::ptr::null(), |function| function as *const c_void)
    }
}

impl CurrentContext {
    /// Leaves the context current on this thread.
    pub(crate) fn keep(mut self) {
        self.previous = None;
    }
}

impl Drop for CurrentContext {
    fn drop(&mut self) {
        let Some(previous) = self.previous.as_ref().and_then(Weak::upgrade) else { return };
        if let Err(error) = previous.bind() {
            // The next use of the previous context makes it current first, or returns the error.
            tracing::warn!(%error, "the previous OpenGL context is not current again");
        }
    }
}

impl ContextHandle {
    /// Asks EGL to make the context current on this thread.
    fn bind(self: &Rc<Self>) -> Result<()> {
        // If EGL fails, the current context is unknown.
        CURRENT_CONTEXT.with(|current| current.replace(Weak::new()));
        let result = api()?.instance.make_current(self.display, None, None, Some(self.context));
        result.map_err(fault_in("eglMakeCurrent"))?;
        CURRENT_CONTEXT.with(|current| current.replace(Rc::downgrade(self)));
        Ok(())
    }
}

impl Drop for ContextHandle {
    fn drop(&mut self) {
        let Ok(api) = api() else { return };
        let _lock = lock_contexts();
        // While this context is dropped, its reference count is 0. Another context that is current has a higher count,
        // and stays current.
        if CURRENT_CONTEXT.with(|current| current.borrow().strong_count()) == 0 {
            api.instance.make_current(self.display, None, None, None).ok();
        }
        // Destroying fails only for a context that no longer exists.
        api.instance.destroy_context(self.display, self.context).ok();
    }
}

/// Chooses a config without window support. The default surface type is WINDOW, which headless devices do not offer.
fn choose_config(instance: &Instance, display: egl::Display) -> Result<egl::Config> {
    for surface_type in [egl::PBUFFER_BIT, 0] {
        let attributes = [egl::SURFACE_TYPE, surface_type, egl::RENDERABLE_TYPE, egl::OPENGL_BIT, egl::NONE];
        if let Ok(Some(config)) = instance.choose_first_config(display, &attributes) {
            return Ok(config);
        }
    }
    Err(fault("EGL config", "expected a config for desktop OpenGL, got none"))
}

#[cfg(test)]
pub(crate) mod testing {
    use std::sync::mpsc::{SyncSender, sync_channel};
    use std::thread::JoinHandle;

    use super::*;

    /// Held by the thread of the test that draws.
    static DRAWING: Mutex<()> = Mutex::new(());

    thread_local! {
        /// Released when the thread ends.
        static TURN: RefCell<Option<MutexGuard<'static, ()>>> = const { RefCell::new(None) };
    }

    /// Lets one test at a time draw, as the server does on one thread. Mesa's software renderer shares its threads
    /// between all contexts of a process, and has crashed while two tests drew. Each test has a thread of its own.
    pub(super) fn wait_for_other_tests() {
        TURN.with_borrow_mut(|turn| {
            // A test that failed leaves the lock poisoned.
            turn.get_or_insert_with(|| DRAWING.lock().unwrap_or_else(PoisonError::into_inner));
        });
    }

    /// Keeps a context current on another thread, so that EGL cannot make it current on this thread.
    pub(crate) struct OccupiedContext {
        release_sender: Option<SyncSender<()>>,
        thread: Option<JoinHandle<()>>,
    }

    impl Context {
        /// Makes the context current on another thread until the returned value is dropped.
        pub(crate) fn occupy(&self) -> OccupiedContext {
            // Addresses as integers, because pointers cannot be sent to another thread.
            let handles = [self.handle.display.as_ptr() as usize, self.handle.context.as_ptr() as usize];
            let instance = &api().expect("EGL").instance;
            if self.is_current() {
                CURRENT_CONTEXT.with(|current| current.replace(Weak::new()));
                instance.make_current(self.handle.display, None, None, None).expect("a released context");
            }
            let ((release_sender, release_receiver), (occupied_sender, occupied_receiver)) =
                (sync_channel::<()>(1), sync_channel(1));
            let thread = std::thread::spawn(move || {
                // SAFETY: the handles of a context and its display, which outlive the thread: it is joined on drop.
                let (display, context) = unsafe {
                    (egl::Display::from_ptr(handles[0] as EglHandle), egl::Context::from_ptr(handles[1] as EglHandle))
                };
                instance.bind_api(egl::OPENGL_API).expect("OpenGL");
                instance.make_current(display, None, None, Some(context)).expect("a current context");
                occupied_sender.send(()).expect("a waiting receiver");
                release_receiver.recv().ok();
                instance.make_current(display, None, None, None).expect("a released context");
            });
            occupied_receiver.recv().expect("an occupied context");
            OccupiedContext { release_sender: Some(release_sender), thread: Some(thread) }
        }

        /// Whether EGL says that the context is current on this thread.
        pub(crate) fn is_current(&self) -> bool {
            let current = api().expect("EGL").instance.get_current_context();
            current.is_some_and(|current| current.as_ptr() == self.handle.context.as_ptr())
        }
    }

    impl Drop for OccupiedContext {
        fn drop(&mut self) {
            self.release_sender.take();
            self.thread.take().map(JoinHandle::join).expect("a thread").expect("no panic");
        }
    }
}
