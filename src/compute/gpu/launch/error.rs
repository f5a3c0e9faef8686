//! Converts errors of the CUDA driver to [`Error`]. Distinguishes a lost device from a fault after which the device
//! still works.

use cudarc::driver::DriverError;
use cudarc::driver::sys::CUresult;

use modalcast_model::error::Error;

/// Whether the context of the device is lost: every later call fails with the same error (the error is "sticky"), and
/// only a new process can use the device again. These are the errors for which the driver's documentation says "the
/// process must be terminated and relaunched", and the uncorrectable memory errors.
const fn is_device_lost(code: CUresult) -> bool {
    matches!(
        code,
        CUresult::CUDA_ERROR_ECC_UNCORRECTABLE
            | CUresult::CUDA_ERROR_NVLINK_UNCORRECTABLE
            | CUresult::CUDA_ERROR_ILLEGAL_ADDRESS
            | CUresult::CUDA_ERROR_LAUNCH_TIMEOUT
            | CUresult::CUDA_ERROR_CONTEXT_IS_DESTROYED
            | CUresult::CUDA_ERROR_ASSERT
            | CUresult::CUDA_ERROR_HARDWARE_STACK_ERROR
            | CUresult::CUDA_ERROR_ILLEGAL_INSTRUCTION
            | CUresult::CUDA_ERROR_MISALIGNED_ADDRESS
            | CUresult::CUDA_ERROR_INVALID_ADDRESS_SPACE
            | CUresult::CUDA_ERROR_INVALID_PC
            | CUresult::CUDA_ERROR_LAUNCH_FAILED
            | CUresult::CUDA_ERROR_EXTERNAL_DEVICE
    )
}

/// Converts an error of the driver in `stage`, for use with `map_err`: to [`Error::DeviceLost`] if the context is lost,
/// otherwise to [`Error::Fault`].
pub(crate) fn cuda_error(stage: &'static str) -> impl Fn(DriverError) -> Error {
    move |error| {
        let reason = error.to_string();
        if is_device_lost(error.0) { Error::DeviceLost { stage, reason } } else { Error::Fault { stage, reason } }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_sticky_errors_lose_the_device() {
        for (code, is_lost) in [
            (CUresult::CUDA_ERROR_ILLEGAL_ADDRESS, true),
            (CUresult::CUDA_ERROR_LAUNCH_FAILED, true),
            (CUresult::CUDA_ERROR_ILLEGAL_INSTRUCTION, true),
            (CUresult::CUDA_ERROR_LAUNCH_TIMEOUT, true),
            (CUresult::CUDA_ERROR_OUT_OF_MEMORY, false),
            (CUresult::CUDA_ERROR_INVALID_VALUE, false),
            (CUresult::CUDA_ERROR_ALREADY_MAPPED, false),
        ] {
            assert_eq!(is_device_lost(code), is_lost, "{code:?}");
        }
    }

    /// The test creates the error itself: the text of a `DriverError` comes from the driver library, which may be
    /// missing.
    #[test]
    fn lost_device_error_names_the_remedy() {
        let error = Error::DeviceLost { stage: "deform", reason: "illegal address".into() };
        assert!(error.to_string().ends_with("Restart the server"), "{error}");
    }
}
