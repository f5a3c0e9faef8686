//! The loss of the renderer or of the device. The device thread and the watchdog record it. Every other task observes it.
//! A lost renderer is opened again; after the first [`Error::DeviceLost`], the device is lost for ever.

use std::sync::Arc;

use tokio::sync::watch;

use modalcast_model::error::{Error, Result};

/// What the device can do.
#[derive(Debug, Clone, PartialEq)]
enum DeviceStatus {
    Working,
    /// The renderer is lost with this error, and is being opened again.
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

    /// Records an error that reports a loss. Other errors change nothing.
    pub(super) fn record(&self, error: &Error) {
        let is_first = self.0.send_if_modified(|status| match (error, &*status) {
            (Error::DeviceLost { .. }, DeviceStatus::Working | DeviceStatus::Recovering(_)) => {
                *status = DeviceStatus::Lost(error.clone());
                true
            }
            (Error::RendererLost { .. }, DeviceStatus::Working) => {
                *status = DeviceStatus::Recovering(error.clone());
                true
            }
            _ => false,
        });
        match error {
            Error::DeviceLost { .. } if is_first => {
                tracing::error!(%error, "the device is lost; every scene is closed")
            }
            Error::RendererLost { .. } if is_first => tracing::error!(%error, "the renderer is lost"),
            _ => {}
        }
    }

    /// Records that the renderer is open again.
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

    /// The error that reported the loss of the renderer, until it is open again.
    pub(super) fn renderer_error(&self) -> Option<Error> {
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

    /// Whether the renderer and the device work.
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
