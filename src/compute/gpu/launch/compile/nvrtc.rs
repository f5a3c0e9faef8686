//! Compiles CUDA C++ source to machine code for one architecture with NVRTC, which is found and loaded at run time.

use std::ffi::{CStr, CString, c_char, c_int, c_void};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use libloading::Library;

use modalcast_model::error::{Error, Result, fault_in};

/// How to install NVRTC.
const REMEDY: &str = "Install the PyPI wheel nvidia-cuda-nvrtc==13.0.* (pip install --target .tools/nvrtc \
                      'nvidia-cuda-nvrtc==13.0.*'), or set MODALCAST_NVRTC to the path of libnvrtc.so.13";

/// Headers that kernels may include, by name.
const HEADERS: [(&str, &str); 16] = [
    ("layout.cuh", include_str!("../../../../../kernels/layout.cuh")),
    ("batch_load.cuh", include_str!("../../../../../kernels/batch_load.cuh")),
    ("dependent_launch.cuh", include_str!("../../../../../kernels/dependent_launch.cuh")),
    ("chunk.cuh", include_str!("../../../../../kernels/chunk.cuh")),
    ("cut_out.cuh", include_str!("../../../../../kernels/cut_out.cuh")),
    ("transform.cuh", include_str!("../../../../../kernels/transform.cuh")),
    ("ordered_float.cuh", include_str!("../../../../../kernels/ordered_float.cuh")),
    ("png.cuh", include_str!("../../../../../kernels/png.cuh")),
    ("png_crc.cuh", include_str!("../../../../../kernels/png_crc.cuh")),
    ("png_huffman.cuh", include_str!("../../../../../kernels/png_huffman.cuh")),
    ("raster.cuh", include_str!("../../../../../kernels/raster.cuh")),
    ("raster_setup.cuh", include_str!("../../../../../kernels/raster_setup.cuh")),
    ("view_shading.cuh", include_str!("../../../../../kernels/view_shading.cuh")),
    ("warp_tile.cuh", include_str!("../../../../../kernels/warp_tile.cuh")),
    ("rigid_normals.cuh", include_str!("../../../../../kernels/rigid_normals.cuh")),
    ("direction.cuh", include_str!("../../../../../kernels/direction.cuh")),
];

/// The code of `NVRTC_ERROR_INVALID_OPTION`; here it means an architecture that this NVRTC does not support.
const INVALID_OPTION: c_int = 5;

type ProgramHandle = *mut c_void;

/// The NVRTC functions in use, and the libraries that they need.
struct NvrtcApi {
    version: unsafe extern "C" fn(*mut c_int, *mut c_int) -> c_int,
    error: unsafe extern "C" fn(c_int) -> *const c_char,
    create: unsafe extern "C" fn(
        *mut ProgramHandle,
        *const c_char,
        *const c_char,
        c_int,
        *const *const c_char,
        *const *const c_char,
    ) -> c_int,
    destroy: unsafe extern "C" fn(*mut ProgramHandle) -> c_int,
    compile: unsafe extern "C" fn(ProgramHandle, c_int, *const *const c_char) -> c_int,
    cubin_size: unsafe extern "C" fn(ProgramHandle, *mut usize) -> c_int,
    cubin: unsafe extern "C" fn(ProgramHandle, *mut c_char) -> c_int,
    log_size: unsafe extern "C" fn(ProgramHandle, *mut usize) -> c_int,
    log: unsafe extern "C" fn(ProgramHandle, *mut c_char) -> c_int,
    _libraries: Vec<Library>,
}

/// A loaded NVRTC.
pub(crate) struct Nvrtc {
    functions: NvrtcApi,
    /// Path of the library, or the name that the loader resolved.
    pub path: PathBuf,
    /// Major and minor version.
    pub version: (i32, i32),
}

impl std::fmt::Debug for Nvrtc {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("Nvrtc").field("path", &self.path).field("version", &self.version).finish()
    }
}

/// A source and its compiler options.
#[derive(Debug)]
pub(crate) struct CompileJob<'a> {
    pub name: &'a str,
    pub source: &'a str,
    pub options: Vec<String>,
}

impl<'a> CompileJob<'a> {
    /// Compiles `source` for compute capability `major.minor`, with the macros in `defines`.
    pub(crate) fn new(name: &'a str, source: &'a str, defines: &[&str], capability: (i32, i32)) -> Self {
        let (major, minor) = capability;
        // The options for arithmetic are explicit, because results must follow IEEE 754, including denormals.
        let mut options: Vec<String> =
            ["--std=c++17", "--fmad=true", "--ftz=false", "--prec-div=true", "--prec-sqrt=true"]
                .map(String::from)
                .into();
        options.push(format!("--gpu-architecture=sm_{major}{minor}"));
        options.extend(defines.iter().map(|define| format!("--define-macro={define}")));
        Self { name, source, options }
    }

    /// Everything that determines the machine code, except the compiler version.
    pub(super) fn cache_key_parts(&self) -> Vec<&str> {
        let headers = HEADERS.iter().flat_map(|(name, text)| [*name, *text]);
        [self.name, self.source].into_iter().chain(headers).chain(self.options.iter().map(String::as_str)).collect()
    }
}

/// The NVRTC of this process, loaded at the first call.
///
/// # Errors
/// `Unavailable` with the failed candidate and the wheel to install.
pub(crate) fn nvrtc() -> Result<&'static Nvrtc> {
    static LOADED: OnceLock<Result<Nvrtc>> = OnceLock::new();
    LOADED.get_or_init(|| Nvrtc::find(&candidates())).as_ref().map_err(Clone::clone)
}

impl Nvrtc {
    fn find(candidates: &[PathBuf]) -> Result<Self> {
        let mut reason = format!("found in none of {} places", candidates.len());
        for candidate in candidates {
            match Self::load(candidate) {
                Ok(nvrtc) => return Ok(nvrtc),
                // A file that exists but does not load is more informative than a name that the loader cannot find.
                Err(error) if candidate.is_file() || candidates.len() == 1 => {
                    reason = format!("{}: {error}", candidate.display());
                }
                Err(_) => {}
            }
        }
        Err(Error::Unavailable { what: "NVRTC", reason, remedy: REMEDY.into() })
    }

    fn load(path: &Path) -> Result<Self> {
        let fail = fault_in("nvrtc");
        // SAFETY: NVRTC's initializers only set up the library; the operator chooses the name or path.
        let library = unsafe { Library::new(path) }.map_err(|error| fail(error.to_string()))?;
        let functions = NvrtcApi::bind(library, load_builtins(path)).map_err(|error| fail(error.to_string()))?;
        let (mut major, mut minor) = (0, 0);
        // SAFETY: both pointers refer to live integers.
        let code = unsafe { (functions.version)(&mut major, &mut minor) };
        functions.check(code).map_err(fail)?;
        let nvrtc = Self { functions, path: path.to_path_buf(), version: (major, minor) };
        // Only a compilation shows whether NVRTC finds its builtins library.
        nvrtc.compile(&CompileJob { name: "empty", source: "", options: Vec::new() })?;
        Ok(nvrtc)
    }

    /// Machine code (a cubin) of a job.
    ///
    /// # Errors
    /// `Fault` with the compiler's log; `Unavailable` when this NVRTC does not know the architecture.
    pub(crate) fn compile(&self, job: &CompileJob) -> Result<Vec<u8>> {
        self.compile_with_log(job).map(|(cubin, _)| cubin)
    }

    /// Machine code (a cubin) of a job, and the compiler's log.
    pub(super) fn compile_with_log(&self, job: &CompileJob) -> Result<(Vec<u8>, String)> {
        let fail = fault_in("compile");
        let options = c_strings(job.options.iter().map(String::as_str))?;
        let pointers: Vec<_> = options.iter().map(|option| option.as_ptr()).collect();
        let program = NvrtcProgram::create(&self.functions, job)?;
        // SAFETY: the program is live, and `pointers` holds the stated number of NUL-terminated strings.
        let code = unsafe { (self.functions.compile)(program.handle, pointers.len() as c_int, pointers.as_ptr()) };
        let log = program.bytes(self.functions.log_size, self.functions.log).unwrap_or_default();
        let log = String::from_utf8_lossy(&log).trim_end_matches('\0').trim().to_owned();
        if code == INVALID_OPTION {
            let reason = format!("version {}.{} refused {:?}: {log}", self.version.0, self.version.1, job.options);
            return Err(Error::Unavailable { what: "NVRTC for this device", reason, remedy: REMEDY.into() });
        }
        self.functions.check(code).map_err(|error| fail(format!("{}: {error}: {log}", job.name)))?;
        let cubin = program.bytes(self.functions.cubin_size, self.functions.cubin).map_err(fail)?;
        Ok((cubin, log))
    }
}

impl NvrtcApi {
    fn bind(library: Library, builtins: Vec<Library>) -> Result<Self, libloading::Error> {
        // SAFETY: the types match nvrtc.h of CUDA 11.1 to 13; the library is kept as long as the functions.
        unsafe {
            Ok(Self {
                version: *library.get(b"nvrtcVersion\0")?,
                error: *library.get(b"nvrtcGetErrorString\0")?,
                create: *library.get(b"nvrtcCreateProgram\0")?,
                destroy: *library.get(b"nvrtcDestroyProgram\0")?,
                compile: *library.get(b"nvrtcCompileProgram\0")?,
                cubin_size: *library.get(b"nvrtcGetCUBINSize\0")?,
                cubin: *library.get(b"nvrtcGetCUBIN\0")?,
                log_size: *library.get(b"nvrtcGetProgramLogSize\0")?,
                log: *library.get(b"nvrtcGetProgramLog\0")?,
                _libraries: std::iter::once(library).chain(builtins).collect(),
            })
        }
    }

    fn check(&self, code: c_int) -> Result<(), String> {
        if code == 0 {
            return Ok(());
        }
        // SAFETY: NVRTC returns a NUL-terminated string of static lifetime for any code.
        Err(unsafe { CStr::from_ptr((self.error)(code)) }.to_string_lossy().into_owned())
    }
}

/// An NVRTC program; destroyed on drop.
struct NvrtcProgram<'a> {
    functions: &'a NvrtcApi,
    handle: ProgramHandle,
}

impl<'a> NvrtcProgram<'a> {
    fn create(functions: &'a NvrtcApi, job: &CompileJob) -> Result<Self> {
        let texts = c_strings([job.source, job.name])?;
        let names = c_strings(HEADERS.iter().map(|(name, _)| *name))?;
        let headers = c_strings(HEADERS.iter().map(|(_, text)| *text))?;
        let names: Vec<_> = names.iter().map(|name| name.as_ptr()).collect();
        let headers: Vec<_> = headers.iter().map(|text| text.as_ptr()).collect();
        let mut handle = std::ptr::null_mut();
        let count = HEADERS.len() as c_int;
        // SAFETY: all strings are NUL-terminated and outlive the call, which copies them; the lists have `count` items.
        let code = unsafe {
            let (source, name) = (texts[0].as_ptr(), texts[1].as_ptr());
            (functions.create)(&mut handle, source, name, count, headers.as_ptr(), names.as_ptr())
        };
        functions.check(code).map_err(fault_in("compile"))?;
        Ok(Self { functions, handle })
    }

    /// Queries a size, then reads that many bytes.
    fn bytes(
        &self,
        size: unsafe extern "C" fn(ProgramHandle, *mut usize) -> c_int,
        read: unsafe extern "C" fn(ProgramHandle, *mut c_char) -> c_int,
    ) -> Result<Vec<u8>, String> {
        let mut length = 0;
        // SAFETY: the program is live and `length` is a live integer.
        self.functions.check(unsafe { size(self.handle, &mut length) })?;
        let mut bytes = vec![0_u8; length];
        // SAFETY: NVRTC writes exactly `length` bytes, the size of the buffer.
        self.functions.check(unsafe { read(self.handle, bytes.as_mut_ptr().cast()) })?;
        Ok(bytes)
    }
}

impl Drop for NvrtcProgram<'_> {
    fn drop(&mut self) {
        // SAFETY: the handle came from `create` and is destroyed once.
        // If destruction fails, nothing can be done, so the error is ignored.
        let _ = unsafe { (self.functions.destroy)(&mut self.handle) };
    }
}

/// Loads NVRTC's builtins library from the folder of NVRTC. NVRTC opens it by name without a path. The loader then
/// finds it only in the search path, or if it is already loaded.
fn load_builtins(nvrtc_path: &Path) -> Vec<Library> {
    let folder = nvrtc_path.parent().filter(|folder| !folder.as_os_str().is_empty());
    let files = folder.map(entries).unwrap_or_default().into_iter();
    let is_builtins = |file: &PathBuf| {
        file.file_name().is_some_and(|name| name.to_string_lossy().starts_with("libnvrtc-builtins.so"))
    };
    // SAFETY: it is a data library without initializers, from the folder that the operator chose for NVRTC.
    files.filter(is_builtins).filter_map(|file| unsafe { Library::new(file) }.ok()).collect()
}

fn c_strings<'a>(texts: impl IntoIterator<Item = &'a str>) -> Result<Vec<CString>> {
    texts.into_iter().map(|text| CString::new(text).map_err(fault_in("compile"))).collect()
}

/// Maximum depth of the folder in a wheel that contains the library, for example `nvidia/cu13/lib`, with a margin.
const MAX_WHEEL_DEPTH: usize = 5;

/// Candidate paths of NVRTC, best first. If MODALCAST_NVRTC is set, it is the only candidate.
fn candidates() -> Vec<PathBuf> {
    if let Some(path) = std::env::var_os("MODALCAST_NVRTC").filter(|path| !path.is_empty()) {
        return vec![path.into()];
    }
    let mut paths: Vec<PathBuf> = ["libnvrtc.so.13", "libnvrtc.so"].map(PathBuf::from).into();
    let executable = std::env::current_exe().ok();
    // The folder of the program and the three above, which include the repository of `target/release/modalcast`.
    let parent_folders = executable.iter().flat_map(|path| path.ancestors().skip(1).take(4));
    // Never search the working directory: starting the server in some folder must not execute a library in it.
    for folder in parent_folders {
        find_libraries(&folder.join(".tools/nvrtc"), MAX_WHEEL_DEPTH, &mut paths);
    }
    // The environment into which a wheel has installed the program as `bin/modalcast`, and perhaps NVRTC.
    let environment = executable.iter().flat_map(|path| path.ancestors().nth(2));
    environment.for_each(|folder| find_in_python_environment(folder, &mut paths));
    for toolkit in entries(Path::new("/usr/local")) {
        if toolkit.file_name().is_some_and(|name| name.to_string_lossy().starts_with("cuda")) {
            let folder = toolkit.join("lib64");
            paths.extend(["libnvrtc.so.13", "libnvrtc.so"].map(|name| folder.join(name)));
        }
    }
    paths.push("libnvrtc.so.12".into());
    paths
}

/// Adds the libraries of NVIDIA's wheels in a Python environment.
fn find_in_python_environment(environment: &Path, paths: &mut Vec<PathBuf>) {
    for python in entries(&environment.join("lib")) {
        find_libraries(&python.join("site-packages/nvidia"), MAX_WHEEL_DEPTH, paths);
    }
}

/// Adds every `libnvrtc.so.13` at most `depth` folders below `folder`.
fn find_libraries(folder: &Path, depth: usize, paths: &mut Vec<PathBuf>) {
    for entry in entries(folder) {
        if entry.file_name().is_some_and(|name| name == "libnvrtc.so.13") {
            paths.push(entry);
        } else if depth > 0 && entry.is_dir() {
            find_libraries(&entry, depth - 1, paths);
        }
    }
}

/// Paths of the entries of a folder, sorted; empty when the folder cannot be read.
fn entries(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<_> =
        std::fs::read_dir(folder).into_iter().flatten().filter_map(|entry| Some(entry.ok()?.path())).collect();
    paths.sort();
    paths
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_or_broken_nvrtc_is_unavailable() {
        let folder = tempfile::tempdir().expect("a folder");
        let missing = Nvrtc::find(&[folder.path().join("libnvrtc.so.13")]).expect_err("a missing library").to_string();
        assert!(missing.contains("nvidia-cuda-nvrtc==13.0.*"), "{missing}");
        let broken = folder.path().join("nvidia/cu13/lib/libnvrtc.so.13");
        std::fs::create_dir_all(broken.parent().expect("a parent")).expect("a folder");
        std::fs::write(&broken, b"no library").expect("a file");
        let mut paths = Vec::new();
        find_libraries(folder.path(), MAX_WHEEL_DEPTH, &mut paths);
        assert_eq!(paths, std::slice::from_ref(&broken));
        let error = Nvrtc::find(&paths).expect_err("a broken library").to_string();
        assert!(error.contains(&broken.display().to_string()), "{error}");
    }

    #[test]
    fn finds_the_wheel_of_a_python_environment() {
        let environment = tempfile::tempdir().expect("a folder");
        let library = environment.path().join("lib/python3.11/site-packages/nvidia/cu13/lib/libnvrtc.so.13");
        std::fs::create_dir_all(library.parent().expect("a parent")).expect("a folder");
        std::fs::write(&library, b"").expect("a file");
        let mut paths = Vec::new();
        find_in_python_environment(environment.path(), &mut paths);
        assert_eq!(paths, [library]);
    }
}
