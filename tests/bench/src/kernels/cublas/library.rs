//! Loads cuBLAS at run time and wraps its handle. Only benchmarks use it, so the server does not depend on it.

use std::ffi::{CStr, c_char, c_int, c_void};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use cudarc::driver::CudaSlice;
use libloading::Library;

use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::memory::{address, alloc_zeroed};
use modalcast_model::error::{Error, Result, fault_in};

/// Remedy in the error message when cuBLAS is missing.
const REMEDY: &str = "Install the PyPI wheel nvidia-cublas==13.* and set MODALCAST_CUBLAS to the path of its \
                      libcublas.so.13, or leave its trials out";

/// Workspace of cuBLAS, bytes, as its manual recommends for Hopper. With it, calls can be captured in graphs.
const WORKSPACE: u64 = 32 << 20;

type Handle = *mut c_void;

/// The used functions, in the types of cublas_v2.h; device pointers are `u64` addresses. Old versions lack the two
/// optional ones.
#[allow(clippy::type_complexity, reason = "the types are those of a C header")]
struct CublasFunctions {
    property: unsafe extern "C" fn(c_int, *mut c_int) -> c_int,
    status: unsafe extern "C" fn(c_int) -> *const c_char,
    create: unsafe extern "C" fn(*mut Handle) -> c_int,
    destroy: unsafe extern "C" fn(Handle) -> c_int,
    set_stream: unsafe extern "C" fn(Handle, *mut c_void) -> c_int,
    set_workspace: unsafe extern "C" fn(Handle, u64, usize) -> c_int,
    sgemv: unsafe extern "C" fn(
        Handle,
        c_int,
        c_int,
        c_int,
        *const f32,
        u64,
        c_int,
        u64,
        c_int,
        *const f32,
        u64,
        c_int,
    ) -> c_int,
    sgemm: unsafe extern "C" fn(
        Handle,
        c_int,
        c_int,
        c_int,
        c_int,
        c_int,
        *const f32,
        u64,
        c_int,
        u64,
        c_int,
        *const f32,
        u64,
        c_int,
    ) -> c_int,
    sgemm_strided: unsafe extern "C" fn(
        Handle,
        c_int,
        c_int,
        c_int,
        c_int,
        c_int,
        *const f32,
        u64,
        c_int,
        i64,
        u64,
        c_int,
        i64,
        *const f32,
        u64,
        c_int,
        i64,
        c_int,
    ) -> c_int,
    sgemv_strided: Option<
        unsafe extern "C" fn(
            Handle,
            c_int,
            c_int,
            c_int,
            *const f32,
            u64,
            c_int,
            i64,
            u64,
            c_int,
            i64,
            *const f32,
            u64,
            c_int,
            i64,
            c_int,
        ) -> c_int,
    >,
    sgemm_grouped: Option<
        unsafe extern "C" fn(
            Handle,
            *const c_int,
            *const c_int,
            *const c_int,
            *const c_int,
            *const c_int,
            *const f32,
            u64,
            *const c_int,
            u64,
            *const c_int,
            *const f32,
            u64,
            *const c_int,
            c_int,
            *const c_int,
        ) -> c_int,
    >,
    _libraries: Vec<Library>,
}

const NO_TRANSPOSE: c_int = 0;
const TRANSPOSE: c_int = 1;

/// The cuBLAS functions of this process, loaded at the first call.
fn functions() -> Result<&'static CublasFunctions> {
    static LOADED: OnceLock<Result<CublasFunctions>> = OnceLock::new();
    LOADED.get_or_init(|| CublasFunctions::find(&candidates())).as_ref().map_err(Clone::clone)
}

/// Version of cuBLAS: major, minor, patch.
///
/// # Errors
/// `Unavailable` when there is no cuBLAS; it lists the paths that were tried.
pub fn cublas_version() -> Result<[i32; 3]> {
    let functions = functions()?;
    let mut version = [0; 3];
    for (kind, number) in version.iter_mut().enumerate() {
        // SAFETY: `number` is a live integer, and the kinds 0 to 2 are major, minor and patch.
        functions.check(unsafe { (functions.property)(kind as c_int, number) })?;
    }
    Ok(version)
}

fn unavailable(reason: String) -> Error {
    Error::Unavailable { what: "cuBLAS", reason, remedy: REMEDY.into() }
}

/// Candidate paths of cuBLAS in order of preference. A path in MODALCAST_CUBLAS is the only candidate.
fn candidates() -> Vec<PathBuf> {
    if let Some(path) = std::env::var_os("MODALCAST_CUBLAS").filter(|path| !path.is_empty()) {
        return vec![path.into()];
    }
    let names = ["libcublas.so.13", "libcublas.so.12", "libcublas.so"];
    let toolkit = Path::new("/usr/local/cuda/lib64");
    names.iter().map(PathBuf::from).chain(names.iter().map(|name| toolkit.join(name))).collect()
}

impl CublasFunctions {
    fn find(candidates: &[PathBuf]) -> Result<Self> {
        let mut reasons = Vec::new();
        for candidate in candidates {
            match Self::load(candidate) {
                Ok(functions) => return Ok(functions),
                Err(error) => reasons.push(format!("{}: {error}", candidate.display())),
            }
        }
        Err(unavailable(reasons.join("; ")))
    }

    fn load(path: &Path) -> Result<Self, libloading::Error> {
        // cuBLAS needs cublasLt. The loader does not find it off the search path unless it is loaded already.
        let beside = |name: &str| Some(path.parent()?.join(name.replace("libcublas.", "libcublasLt.")));
        let second = path.file_name().and_then(|name| beside(&name.to_string_lossy())).filter(|file| file.is_file());
        // SAFETY: the libraries' initializers only set them up; the operator chooses the name or path.
        let (second, library) = unsafe { (second.and_then(|file| Library::new(file).ok()), Library::new(path)?) };
        // SAFETY: the types are those of cublas_v2.h of CUDA 12 and 13 on 64-bit systems, where a device pointer is an
        // address. The libraries are kept as long as the functions.
        unsafe {
            Ok(Self {
                property: *library.get(b"cublasGetProperty\0")?,
                status: *library.get(b"cublasGetStatusString\0")?,
                create: *library.get(b"cublasCreate_v2\0")?,
                destroy: *library.get(b"cublasDestroy_v2\0")?,
                set_stream: *library.get(b"cublasSetStream_v2\0")?,
                set_workspace: *library.get(b"cublasSetWorkspace_v2\0")?,
                sgemv: *library.get(b"cublasSgemv_v2\0")?,
                sgemm: *library.get(b"cublasSgemm_v2\0")?,
                sgemm_strided: *library.get(b"cublasSgemmStridedBatched\0")?,
                sgemv_strided: library.get(b"cublasSgemvStridedBatched\0").ok().map(|function| *function),
                sgemm_grouped: library.get(b"cublasSgemmGroupedBatched\0").ok().map(|function| *function),
                _libraries: std::iter::once(library).chain(second).collect(),
            })
        }
    }

    fn check(&self, code: c_int) -> Result<()> {
        if code == 0 {
            return Ok(());
        }
        // SAFETY: cuBLAS returns a NUL-terminated string of static lifetime for any code.
        let text = unsafe { CStr::from_ptr((self.status)(code)) }.to_string_lossy().into_owned();
        Err(fault_in("cublas")(text))
    }
}

/// C = A B for column-major matrices on the device: A is rows x inner, B inner x columns. `count` such products lie at
/// regular strides.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct GemmCall {
    pub rows: i32,
    pub inner: i32,
    pub columns: i32,
    /// Leading dimension of A and C in floats. The columns of B are contiguous.
    pub lead: i32,
    /// Number of products, and floats from one A, B and C to the next.
    pub count: i32,
    pub strides: [i64; 3],
}

/// Arguments of a grouped product: one entry per group on the host, and device arrays with one pointer per problem.
#[derive(Debug)]
pub(super) struct GroupedGemm<'a> {
    pub groups: &'a [GemmCall],
    /// Device arrays of pointers to A, B and C.
    pub pointers: [u64; 3],
}

/// A cuBLAS handle on the device's stream.
pub(super) struct CublasHandle {
    functions: &'static CublasFunctions,
    handle: Handle,
    _workspace: CudaSlice<u8>,
}

impl std::fmt::Debug for CublasHandle {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("Blas").finish_non_exhaustive()
    }
}

const ONE: f32 = 1.0;
const ZERO: f32 = 0.0;

impl CublasHandle {
    /// # Errors
    /// `Unavailable` when cuBLAS is missing or does not start; `Fault` when the device fails.
    pub(super) fn new(device: &Device) -> Result<Self> {
        let functions = functions()?;
        device.context().bind_to_thread().map_err(fault_in("device"))?;
        let workspace = alloc_zeroed(device, WORKSPACE)?;
        let mut handle = std::ptr::null_mut();
        // SAFETY: `handle` is a live pointer, and the device's context is current.
        functions.check(unsafe { (functions.create)(&mut handle) }).map_err(|error| unavailable(error.to_string()))?;
        let blas = Self { functions, handle, _workspace: workspace };
        let (stream, memory) = (device.stream().cu_stream().cast(), address(device, &blas._workspace));
        // SAFETY: handle and stream are live, and the workspace has the stated size. The stream is set first because
        // setting it resets the workspace.
        unsafe {
            functions.check((functions.set_stream)(handle, stream))?;
            functions.check((functions.set_workspace)(handle, memory, WORKSPACE as usize))?;
        }
        Ok(blas)
    }

    /// Checks that this version has the grouped and strided functions, if required; otherwise `Unavailable`.
    pub(super) fn check_has(&self, grouped: bool, vectors: bool) -> Result<()> {
        let missing = |name: &str| Err(unavailable(format!("this version has no {name}")));
        match self.functions {
            CublasFunctions { sgemm_grouped: None, .. } if grouped => missing("cublasSgemmGroupedBatched"),
            CublasFunctions { sgemv_strided: None, .. } if vectors => missing("cublasSgemvStridedBatched"),
            _ => Ok(()),
        }
    }

    /// y = A x with `sgemv`, A column-major or, with `by_rows`, row-major.
    ///
    /// # Safety
    /// The addresses are device addresses of matrices with the sizes in `of`; its `columns` and `count` are 1.
    pub(super) unsafe fn gemv(&self, of: GemmCall, by_rows: bool, [a, x, y]: [u64; 3]) -> Result<()> {
        let (transpose, rows, columns, lead) = match by_rows {
            // A row-major matrix is the transpose of a column-major one.
            true => (TRANSPOSE, of.inner, of.rows, of.inner),
            false => (NO_TRANSPOSE, of.rows, of.inner, of.lead),
        };
        // SAFETY: the handle is live; the caller vouches for the matrices.
        self.functions.check(unsafe {
            (self.functions.sgemv)(self.handle, transpose, rows, columns, &ONE, a, lead, x, 1, &ZERO, y, 1)
        })
    }

    /// C = A B with `sgemm`.
    ///
    /// # Safety
    /// The addresses are device addresses of matrices with the sizes in `of`; its `count` is 1.
    pub(super) unsafe fn gemm(&self, of: GemmCall, [a, b, c]: [u64; 3]) -> Result<()> {
        let GemmCall { rows, inner, columns, lead, .. } = of;
        let (handle, no) = (self.handle, NO_TRANSPOSE);
        // SAFETY: the handle is live; the caller vouches for the matrices.
        self.functions.check(unsafe {
            (self.functions.sgemm)(handle, no, no, rows, columns, inner, &ONE, a, lead, b, inner, &ZERO, c, lead)
        })
    }

    /// Strided batched products: `sgemm`, or `sgemv` if `as_vectors`.
    ///
    /// # Safety
    /// The addresses are those of `count` matrices as `of` says; with `as_vectors`, its `columns` is 1.
    pub(super) unsafe fn strided(&self, of: GemmCall, as_vectors: bool, [a, b, c]: [u64; 3]) -> Result<()> {
        let GemmCall { rows, inner, columns, lead, count, strides: [to_a, to_b, to_c] } = of;
        let (handle, no) = (self.handle, NO_TRANSPOSE);
        let code = match self.functions.sgemv_strided.filter(|_| as_vectors) {
            // SAFETY: the handle is live; the caller vouches for the matrices.
            Some(sgemv) => unsafe {
                sgemv(handle, no, rows, inner, &ONE, a, lead, to_a, b, 1, to_b, &ZERO, c, 1, to_c, count)
            },
            // SAFETY: as above.
            None => unsafe {
                (self.functions.sgemm_strided)(
                    handle, no, no, rows, columns, inner, &ONE, a, lead, to_a, b, inner, to_b, &ZERO, c, lead, to_c,
                    count,
                )
            },
        };
        self.functions.check(code)
    }

    /// Grouped products; each group has `count` problems of one size.
    ///
    /// # Safety
    /// The device arrays hold the device address of a matrix for each problem, in the order of the groups.
    pub(super) unsafe fn grouped(&self, of: &GroupedGemm) -> Result<()> {
        let Some(grouped) = self.functions.sgemm_grouped else {
            return self.check_has(true, false);
        };
        let list = |of_group: fn(&GemmCall) -> c_int| of.groups.iter().map(of_group).collect::<Vec<c_int>>();
        let (rows, columns, inner) = (list(|group| group.rows), list(|group| group.columns), list(|group| group.inner));
        let (lead, counts, no) = (list(|group| group.lead), list(|group| group.count), list(|_| NO_TRANSPOSE));
        let (ones, zeros) = (vec![ONE; of.groups.len()], vec![ZERO; of.groups.len()]);
        let [a, b, c] = of.pointers;
        // SAFETY: the handle is live and every host array has an entry per group; the caller vouches for the rest.
        self.functions.check(unsafe {
            grouped(
                self.handle,
                no.as_ptr(),
                no.as_ptr(),
                rows.as_ptr(),
                columns.as_ptr(),
                inner.as_ptr(),
                ones.as_ptr(),
                a,
                lead.as_ptr(),
                b,
                inner.as_ptr(),
                zeros.as_ptr(),
                c,
                lead.as_ptr(),
                of.groups.len() as c_int,
                counts.as_ptr(),
            )
        })
    }
}

impl Drop for CublasHandle {
    fn drop(&mut self) {
        // SAFETY: the handle came from `create` and is destroyed once; destroying waits for its work. A failure here
        // cannot be handled, so its code is ignored.
        let _ = unsafe { (self.functions.destroy)(self.handle) };
    }
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
            let refusal = CublasFunctions::find(std::slice::from_ref(&path)).err().expect("refused");
            assert!(matches!(refusal, Error::Unavailable { what: "cuBLAS", .. }), "{refusal}");
            let text = refusal.to_string();
            assert!(text.contains(&path.display().to_string()) && text.contains("nvidia-cublas"), "{text}");
        }
    }
}
