//! The loss of the device. The device thread records the first [`Error::DeviceLost`]. Every other task observes it.

use tokio::sync::watch;

use modalcast_model::error::{Error, Result};

/// Records the loss; owned by the device thread.
#[derive(Debug)]
pub(super) struct DeviceLossSender(watch::Sender<Option<Error>>);

/// Observes the loss.
#[derive(Debug, Clone)]
pub(in crate::engine) struct DeviceLoss(watch::Receiver<Option<Error>>);

/// Creates a sender and an observer for a device that is not lost.
pub(super) fn device_loss_channel() -> (DeviceLossSender, DeviceLoss) {
    let (sender, receiver) = watch::channel(None);
    (DeviceLossSender(sender), DeviceLoss(receiver))
}

impl DeviceLossSender {
    /// Returns `result`. Records and logs the first result that reports a lost device.
    pub(super) fn record_loss<T>(&self, result: Result<T>) -> Result<T> {
        if let Err(error @ Error::DeviceLost { .. }) = &result {
            let is_first = self.0.send_if_modified(|loss| {
                let is_first = loss.is_none();
                loss.get_or_insert_with(|| error.clone());
                is_first
            });
            if is_first {
                tracing::error!(%error, "the device is lost; every scene is closed");
            }
        }
        result
    }

    /// The error that reported the loss. `None` if the device is not lost.
    pub(super) fn error(&self) -> Option<Error> {
        self.0.borrow().clone()
    }
}

impl DeviceLoss {
    /// The error that reported the loss. `None` if the device is not lost.
    pub(in crate::engine) fn error(&self) -> Option<Error> {
        self.0.borrow().clone()
    }

    /// Waits until the device is lost. Cancel-safe.
    pub(in crate::engine) async fn wait(&self) -> Error {
        let mut receiver = self.0.clone();
        match receiver.wait_for(Option::is_some).await.map(|loss| loss.clone()) {
            Ok(Some(error)) => error,
            // The device thread has ended without a loss.
            _ => std::future::pending().await,
        }
    }
}
