//! Whether the device is lost. The device thread records the first [`Error::DeviceLost`]; every other task observes it.

use tokio::sync::watch;

use modalcast_model::error::{Error, Result};

/// The device thread's end: records the loss.
#[derive(Debug)]
pub(super) struct DeviceLossSender(watch::Sender<Option<Error>>);

/// The observers' end.
#[derive(Debug, Clone)]
pub(in crate::engine) struct DeviceLoss(watch::Receiver<Option<Error>>);

/// Both ends, for a device that works.
pub(super) fn device_loss() -> (DeviceLossSender, DeviceLoss) {
    let (sender, receiver) = watch::channel(None);
    (DeviceLossSender(sender), DeviceLoss(receiver))
}

impl DeviceLossSender {
    /// Passes a result through; records and logs the first one that reports a lost device.
    pub(super) fn note<T>(&self, result: Result<T>) -> Result<T> {
        if let Err(error @ Error::DeviceLost { .. }) = &result {
            let is_first = self.0.send_if_modified(|lost| {
                let is_first = lost.is_none();
                lost.get_or_insert_with(|| error.clone());
                is_first
            });
            if is_first {
                tracing::error!(%error, "the server cannot go on; every scene is closed");
            }
        }
        result
    }

    /// The error that reported the loss; `None` while the device works.
    pub(super) fn error(&self) -> Option<Error> {
        self.0.borrow().clone()
    }
}

impl DeviceLoss {
    /// The error that reported the loss; `None` while the device works.
    pub(in crate::engine) fn error(&self) -> Option<Error> {
        self.0.borrow().clone()
    }

    /// Waits until the device is lost. Cancel-safe.
    pub(in crate::engine) async fn wait(&self) -> Error {
        let mut lost = self.0.clone();
        match lost.wait_for(Option::is_some).await.map(|lost| lost.clone()) {
            Ok(Some(error)) => error,
            // The device thread has ended and the device was not lost.
            _ => std::future::pending().await,
        }
    }
}
