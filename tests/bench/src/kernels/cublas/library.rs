//! Loads cuBLAS at run time and wraps its handle. Only benchmarks use it, so the server does not depend on it.
//!
//! cuBLAS is called through cudarc. cudarc looks for the library by its name only and panics if it finds none.
//! Therefore [`load`] loads the library first, from the path in `MODALCAST_CUBLAS` if it is set, and checks that cudarc
//! uses the same library.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use cudarc::cublas::result::{self, CublasError};
use cudarc::cublas::sys::{self, cublasHandle_t, cublasOperation_t, libraryPropertyType};
use libloading::Library;

use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_model::error::{Error, Result, fault_in};

/// Remedy in the error message when cuBLAS is missing.
const REMEDY: &str = "Install the PyPI wheel nvidia-cublas==13.* and set MODALCAST_CUBLAS to the path of its \
                      libcublas.so.13, or do not select its variants";

/// Workspace of cuBLAS, bytes, as its manual recommends for Hopper. With a workspace, graphs can capture calls.
const WORKSPACE_BYTES: u64 = 32 << 20;

const NO_TRANSPOSE: cublasOperation_t = cublasOperation_t::CUBLAS_OP_N;
const TRANSPOSE: cublasOperation_t = cublasOperation_t::CUBLAS_OP_T;

/// The loaded cuBLAS. It stays loaded until the process ends.
struct CublasLibrary {
    library: Library,
    /// cublasLt, if it was loaded from the folder of cuBLAS.
    _cublas_lt: Option<Library>,
}

/// The library of this process, loaded at the first call.
fn library() -> Result<&'static CublasLibrary> {
    static LIBRARY: OnceLock<Result<CublasLibrary>> = OnceLock::new();
    LIBRARY.get_or_init(|| load(&candidates())).as_ref().map_err(Clone::clone)
}

/// Version of cuBLAS: major, minor, patch.
///
/// # Errors
/// `Unavailable` when there is no cuBLAS; it lists the paths that were tried.
pub fn cublas_version() -> Result<[i32; 3]> {
    library()?;
    let properties =
        [libraryPropertyType::MAJOR_VERSION, libraryPropertyType::MINOR_VERSION, libraryPropertyType::PATCH_LEVEL];
    let mut version = [0; 3];
    for (property, number) in properties.into_iter().zip(&mut version) {
        // SAFETY: `number` is a live integer.
        unsafe { sys::cublasGetProperty(property, number) }.result().map_err(fault_in("cublas"))?;
    }
    Ok(version)
}

fn unavailable(reason: String) -> Error {
    Error::Unavailable { what: "cuBLAS", reason, remedy: REMEDY.into() }
}

/// Paths at which to look for cuBLAS, in order of preference. If MODALCAST_CUBLAS is set, its path is the only
/// candidate.
fn candidates() -> Vec<PathBuf> {
    if let Some(path) = std::env::var_os("MODALCAST_CUBLAS").filter(|path| !path.is_empty()) {
        return vec![path.into()];
    }
    let names = ["libcublas.so.13", "libcublas.so.12", "libcublas.so"];
    let toolkit = Path::new("/usr/local/cuda/lib64");
    names.iter().map(PathBuf::from).chain(names.iter().map(|name| toolkit.join(name))).collect()
}

/// Loads the first candidate that can be loaded and checks that cudarc uses it.
///
/// # Errors
/// `Unavailable` when no candidate can be loaded, or cudarc finds another library.
fn load(candidates: &[PathBuf]) -> Result<CublasLibrary> {
    let mut reasons = Vec::new();
    for candidate in candidates {
        match CublasLibrary::open(candidate) {
            Ok(library) if library.is_used_by_cudarc() => return Ok(library),
            Ok(_) => reasons.push(format!("{}: cudarc finds another cuBLAS or none", candidate.display())),
            Err(error) => reasons.push(format!("{}: {error}", candidate.display())),
        }
    }
    Err(unavailable(reasons.join("; ")))
}

impl CublasLibrary {
    fn open(path: &Path) -> Result<Self, libloading::Error> {
        // cuBLAS needs cublasLt. Outside of the search path, the loader finds cublasLt only if it is already loaded.
        let cublas_lt_path = |name: &str| Some(path.parent()?.join(name.replace("libcublas.", "libcublasLt.")));
        let cublas_lt_file =
            path.file_name().and_then(|name| cublas_lt_path(&name.to_string_lossy())).filter(|file| file.is_file());
        // SAFETY: the initializers of cuBLAS and cublasLt have no preconditions. The operator chooses the name or path.
        let (cublas_lt, library) =
            unsafe { (cublas_lt_file.and_then(|file| Library::new(file).ok()), Library::new(path)?) };
        Ok(Self { library, _cublas_lt: cublas_lt })
    }

    /// Whether cudarc resolves its functions in this library. cudarc tries a list of library names. The system's loader
    /// identifies a loaded library by its `SONAME`, so cudarc gets this library, unless the search path has a library
    /// whose name is earlier in cudarc's list.
    fn is_used_by_cudarc(&self) -> bool {
        // SAFETY: as in `open`.
        if !unsafe { sys::is_culib_present() } {
            return false;
        }
        // SAFETY: a library is present, so `culib` does not panic. It runs initializers, as `open` does.
        let cudarc_library = unsafe { sys::culib() };
        let create = function_address(&self.library, CREATE);
        create.is_some() && create == function_address(cudarc_library, CREATE)
    }

    /// Whether this version of cuBLAS has a function. cudarc panics when it calls a missing function.
    fn has_function(&self, function: &[u8]) -> bool {
        function_address(&self.library, function).is_some()
    }
}

/// Names of functions in cuBLAS, with the terminating zero that the system's loader expects.
const CREATE: &[u8] = b"cublasCreate_v2\0";
const SGEMV_STRIDED: &[u8] = b"cublasSgemvStridedBatched\0";
const SGEMM_GROUPED: &[u8] = b"cublasSgemmGroupedBatched\0";

fn function_address(library: &Library, function: &[u8]) -> Option<usize> {
    // SAFETY: the symbol is not called; only its address is read.
    let symbol = unsafe { library.get::<unsafe extern "C" fn()>(function) };
    symbol.ok().map(|symbol| *symbol as usize)
}

/// Sizes of `count` products C = A B of column-major matrices on the device: A is rows x inner, B inner x columns. The
/// matrices of successive products lie at regular strides.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct GemmCall {
    pub rows: i32,
    pub inner: i32,
    pub columns: i32,
    /// Leading dimension of A and C in floats. The columns of B are contiguous.
    pub lead: i32,
    /// Number of products.
    pub count: i32,
    /// Floats from one A, B and C to the next.
    pub strides: [i64; 3],
}

/// Arguments of a grouped product: one entry per group on the host, and device arrays with one pointer per product.
#[derive(Debug)]
pub(super) struct GroupedGemm<'a> {
    pub groups: &'a [GemmCall],
    /// Device arrays of pointers to A, B and C.
    pub pointers: [u64; 3],
}

/// A cuBLAS handle on the device's stream, and the device memory `B` that its calls access.
///
/// The handle owns this memory because destroying the handle waits for its calls: `Drop::drop` runs before the fields
/// are dropped, so the memory is released after the last call.
pub(super) struct CublasHandle<B> {
    handle: cublasHandle_t,
    pub buffers: B,
    workspace: DeviceBuffer,
}

impl<B> std::fmt::Debug for CublasHandle<B> {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("CublasHandle").finish_non_exhaustive()
    }
}

const ONE: f32 = 1.0;
const ZERO: f32 = 0.0;

/// Loads cuBLAS and checks that this version has the functions for grouped products and strided `sgemv`, if needed.
///
/// # Errors
/// `Unavailable` when cuBLAS or such a function is missing.
pub(super) fn check_functions(needs_grouped: bool, needs_strided_gemv: bool) -> Result<()> {
    let library = library()?;
    let missing = |name: &str| Err(unavailable(format!("this version has no {name}")));
    if needs_grouped && !library.has_function(SGEMM_GROUPED) {
        return missing("cublasSgemmGroupedBatched");
    }
    if needs_strided_gemv && !library.has_function(SGEMV_STRIDED) {
        return missing("cublasSgemvStridedBatched");
    }
    Ok(())
}

impl<B> CublasHandle<B> {
    /// A handle whose calls access `buffers`.
    ///
    /// # Errors
    /// `Unavailable` when cuBLAS is missing or does not start; `Fault` when the device fails.
    pub(super) fn new(device: &Device, buffers: B) -> Result<Self> {
        library()?;
        device.context().bind_to_thread().map_err(fault_in("device"))?;
        let workspace = DeviceBuffer::zeroed(device, WORKSPACE_BYTES)?;
        let handle = result::create_handle().map_err(|error| unavailable(error.to_string()))?;
        let cublas = Self { handle, buffers, workspace };
        let (stream, workspace_address) = (device.stream().cu_stream().cast(), cublas.workspace.address());
        // SAFETY: handle and stream are live, and the workspace has the stated size. The stream is set first because
        // setting it resets the workspace.
        unsafe {
            map_status(result::set_stream(handle, stream))?;
            map_status(
                sys::cublasSetWorkspace_v2(handle, workspace_address as *mut _, WORKSPACE_BYTES as usize).result(),
            )?;
        }
        Ok(cublas)
    }

    /// y = A x with `sgemv`, A column-major or, with `by_rows`, row-major.
    ///
    /// # Safety
    /// The addresses are device addresses of matrices with the sizes in `call`; its `columns` and `count` are 1.
    pub(super) unsafe fn gemv(&self, call: GemmCall, by_rows: bool, [a, x, y]: [u64; 3]) -> Result<()> {
        let (transpose, rows, columns, lead) = match by_rows {
            // A row-major matrix is the transpose of a column-major one.
            true => (TRANSPOSE, call.inner, call.rows, call.inner),
            false => (NO_TRANSPOSE, call.rows, call.inner, call.lead),
        };
        // SAFETY: the handle is live, and the caller guarantees the matrices.
        map_status(unsafe {
            let (a, x, y) = (a as *const f32, x as *const f32, y as *mut f32);
            result::sgemv(self.handle, transpose, rows, columns, &ONE, a, lead, x, 1, &ZERO, y, 1)
        })
    }

    /// C = A B with `sgemm`.
    ///
    /// # Safety
    /// The addresses are device addresses of matrices with the sizes in `call`; its `count` is 1.
    pub(super) unsafe fn gemm(&self, call: GemmCall, [a, b, c]: [u64; 3]) -> Result<()> {
        let GemmCall { rows, inner, columns, lead, .. } = call;
        let (handle, transpose) = (self.handle, NO_TRANSPOSE);
        // SAFETY: the handle is live, and the caller guarantees the matrices.
        map_status(unsafe {
            let (a, b, c) = (a as *const f32, b as *const f32, c as *mut f32);
            result::sgemm(handle, transpose, transpose, rows, columns, inner, &ONE, a, lead, b, inner, &ZERO, c, lead)
        })
    }

    /// Strided batched products: `sgemm`, or `sgemv` if `use_gemv`.
    ///
    /// # Safety
    /// The addresses are those of `count` matrices with the sizes and strides in `call`; with `use_gemv`, its `columns`
    /// is 1.
    pub(super) unsafe fn multiply_strided(&self, call: GemmCall, use_gemv: bool, [a, b, c]: [u64; 3]) -> Result<()> {
        let GemmCall { rows, inner, columns, lead, count, strides: [stride_a, stride_b, stride_c] } = call;
        let (handle, transpose) = (self.handle, NO_TRANSPOSE);
        let (a, b, c) = (a as *const f32, b as *const f32, c as *mut f32);
        if use_gemv {
            let (needs_grouped, needs_strided_gemv) = (false, true);
            check_functions(needs_grouped, needs_strided_gemv)?;
            // SAFETY: the handle is live and the function exists; the caller guarantees the matrices.
            let status = unsafe {
                sys::cublasSgemvStridedBatched(
                    handle, transpose, rows, inner, &ONE, a, lead, stride_a, b, 1, stride_b, &ZERO, c, 1, stride_c,
                    count,
                )
            };
            return map_status(status.result());
        }
        // SAFETY: the handle is live, and the caller guarantees the matrices.
        map_status(unsafe {
            result::sgemm_strided_batched(
                handle, transpose, transpose, rows, columns, inner, &ONE, a, lead, stride_a, b, inner, stride_b, &ZERO,
                c, lead, stride_c, count,
            )
        })
    }

    /// Grouped products. Each group has `count` products of one size.
    ///
    /// # Safety
    /// The device arrays hold the device address of a matrix for each product, in the order of the groups.
    pub(super) unsafe fn multiply_grouped(&self, call: &GroupedGemm) -> Result<()> {
        let (needs_grouped, needs_strided_gemv) = (true, false);
        check_functions(needs_grouped, needs_strided_gemv)?;
        let collect = |get_size: fn(&GemmCall) -> i32| call.groups.iter().map(get_size).collect::<Vec<i32>>();
        let (rows, columns, inner) =
            (collect(|group| group.rows), collect(|group| group.columns), collect(|group| group.inner));
        let (lead, counts, transposes) =
            (collect(|group| group.lead), collect(|group| group.count), vec![NO_TRANSPOSE; call.groups.len()]);
        let (ones, zeros) = (vec![ONE; call.groups.len()], vec![ZERO; call.groups.len()]);
        let [a, b, c] = call.pointers;
        // SAFETY: the handle is live, the function exists and every host array has an entry per group; the caller
        // guarantees the device arrays.
        let status = unsafe {
            sys::cublasSgemmGroupedBatched(
                self.handle,
                transposes.as_ptr(),
                transposes.as_ptr(),
                rows.as_ptr(),
                columns.as_ptr(),
                inner.as_ptr(),
                ones.as_ptr(),
                a as *const *const f32,
                lead.as_ptr(),
                b as *const *const f32,
                inner.as_ptr(),
                zeros.as_ptr(),
                c as *const *mut f32,
                lead.as_ptr(),
                call.groups.len() as i32,
                counts.as_ptr(),
            )
        };
        map_status(status.result())
    }
}

impl<B> Drop for CublasHandle<B> {
    fn drop(&mut self) {
        // SAFETY: the handle came from `create_handle` and is destroyed once; destroying waits for its calls. A failure
        // cannot be handled here, so its status is ignored.
        let _ = unsafe { result::destroy_handle(self.handle) };
    }
}

fn map_status(result: Result<(), CublasError>) -> Result<()> {
    result.map_err(fault_in("cublas"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_or_broken_cublas_gives_error_with_remedy() {
        let folder = tempfile::tempdir().expect("a folder");
        let broken = folder.path().join("libcublas.so.13");
        std::fs::write(&broken, b"no library").expect("a file");
        for path in [folder.path().join("nowhere.so"), broken] {
            let error = load(std::slice::from_ref(&path)).err().expect("expected an error");
            assert!(matches!(error, Error::Unavailable { what: "cuBLAS", .. }), "{error}");
            let text = error.to_string();
            assert!(text.contains(&path.display().to_string()) && text.contains("nvidia-cublas"), "{text}");
        }
    }

    /// Names of tests that need a device begin with `gpu_`. This test needs none, because cuBLAS can be loaded without
    /// a device.
    #[test]
    #[ignore = "needs cuBLAS"]
    fn cudarc_uses_the_library_of_the_environment_variable() {
        let path = PathBuf::from(std::env::var_os("MODALCAST_CUBLAS").expect("MODALCAST_CUBLAS"));
        let library = load(&[path]).map_err(|error| error.to_string()).expect("cuBLAS");
        assert!(
            library.has_function(SGEMM_GROUPED)
                && library.has_function(SGEMV_STRIDED)
                && !library.has_function(b"cublasNothing\0")
        );
        assert!(cublas_version().expect("a version")[0] >= 12);
    }
}
