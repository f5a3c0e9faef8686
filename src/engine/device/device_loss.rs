//! The loss of the renderer or of the device. The device thread and the watchdog record it. Every other task observes it.
//! After the loss of the renderer, and after a step that has failed on the device, the renderer is opened and all scenes
//! are loaded again. After the first [`Error::DeviceLost`], the device is lost for ever.

use std::sync::Arc;

use tokio::sync::watch;

use modalcast_model::error::{Error, Result};

/// What the device can do.
#[derive(Debug, Clone, PartialEq)]
enum DeviceStatus {
    Working,
    /// The renderer is lost, or a step has failed, with this error. All scenes are being loaded again.
    Recovering(Error),
    /// The error that reported the loss of the device.
    Lost(Error),
}

/// Records a loss.
#[derive(Debug, Clone)]
pub(super) struct DeviceLossSender(Arc<watch::Sender<DeviceStatus>>);

/// Observes a loss.
#[derive(Debug, Clone)]
pub struct DeviceLoss(watch::Receiver<DeviceStatus>);

/// Creates a sender and an observer for a device that works.
pub(super) fn device_loss_channel() -> (DeviceLossSender, DeviceLoss) {
    let (sender, receiver) = watch::channel(DeviceStatus::Working);
    (DeviceLossSender(Arc::new(sender)), DeviceLoss(receiver))
}

impl DeviceLossSender {
    /// Returns `result`. Records and logs the first result that reports a lost renderer or device.
    pub(super) fn record_loss<T>(&self, result: Result<T>) -> Result<T> {
        if let Err(error) = &result {
            self.record(error);
        }
        result
    }

    /// [`Self::record_loss`] of a step. A fault of the device starts a recovery, too: its memory may contain a part of the
    /// step, and OpenGL may still lack buffers that CUDA has mapped.
    pub(super) fn record_step<T>(&self, result: Result<T>) -> Result<T> {
        if let Err(error @ Error::Fault { .. }) = &result {
            self.begin_recovery(error);
        }
        self.record_loss(result)
    }

    /// Records an error that reports a loss. Other errors change nothing.
    pub(super) fn record(&self, error: &Error) {
        match error {
            Error::DeviceLost { .. } => self.record_lost_device(error),
            Error::RendererLost { .. } => self.begin_recovery(error),
            _ => {}
        }
    }

    fn record_lost_device(&self, error: &Error) {
        let is_first = self.0.send_if_modified(|status| {
            let is_first = lost_device(status).is_none();
            if is_first {
                *status = DeviceStatus::Lost(error.clone());
            }
            is_first
        });
        if is_first {
            tracing::error!(%error, "the device is lost; every scene is closed");
        }
    }

    fn begin_recovery(&self, error: &Error) {
        let is_first = self.0.send_if_modified(|status| {
            let is_first = *status == DeviceStatus::Working;
            if is_first {
                *status = DeviceStatus::Recovering(error.clone());
            }
            is_first
        });
        if is_first {
            tracing::error!(%error, "every scene is being loaded again");
        }
    }

    /// Records that the renderer is open and all scenes are loaded again.
    pub(super) fn record_recovery(&self) {
        self.0.send_if_modified(|status| {
            let is_recovered = matches!(status, DeviceStatus::Recovering(_));
            if is_recovered {
                *status = DeviceStatus::Working;
            }
            is_recovered
        });
    }

    /// The error that reported the loss of the device. `None` if the device is not lost.
    pub(super) fn error(&self) -> Option<Error> {
        lost_device(&self.0.borrow())
    }

    /// The error because of which all scenes must be loaded again.
    pub(super) fn recovery_cause(&self) -> Option<Error> {
        match &*self.0.borrow() {
            DeviceStatus::Recovering(error) => Some(error.clone()),
            DeviceStatus::Working | DeviceStatus::Lost(_) => None,
        }
    }
}

impl DeviceLoss {
    /// The error that reported the loss of the device. `None` if the device is not lost.
    pub(in crate::engine) fn error(&self) -> Option<Error> {
        lost_device(&self.0.borrow())
    }

    /// Waits until the device is lost. Cancel-safe.
    pub(in crate::engine) async fn wait(&self) -> Error {
        let mut receiver = self.0.clone();
        match receiver.wait_for(|status| lost_device(status).is_some()).await.map(|status| lost_device(&status)) {
            Ok(Some(error)) => error,
            // The device thread has ended without a loss.
            _ => std::future::pending().await,
        }
    }

    /// Whether the renderer and the device work, and no scene is being loaded again.
    pub fn is_working(&self) -> bool {
        *self.0.borrow() == DeviceStatus::Working
    }

    /// Waits for the next loss or recovery. Waits for ever after the end of the device thread. Cancel-safe.
    pub async fn changed(&mut self) {
        if self.0.changed().await.is_err() {
            std::future::pending().await
        }
    }
}

fn lost_device(status: &DeviceStatus) -> Option<Error> {
    match status {
        DeviceStatus::Lost(error) => Some(error.clone()),
        DeviceStatus::Working | DeviceStatus::Recovering(_) => None,
    }
}
