//! The calls of a connection, and which of their messages show that the client works.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use crate::admission::PermitHandle;

/// The open calls of a connection. A call counts from the moment when its first message has been received completely.
#[derive(Debug, Default)]
pub(super) struct OpenCalls {
    count: AtomicUsize,
    has_received_request: AtomicBool,
}

/// A call of a connection, until it is dropped.
#[derive(Debug)]
pub(super) struct CountedCall {
    calls: Arc<OpenCalls>,
    is_counted: AtomicBool,
    /// The permit of the connection.
    permit: PermitHandle,
    progress: ProgressSign,
}

/// The messages of a method that are progress of its connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ProgressSign {
    /// None that every call has: health and reflection are not work, and a stream of steps can consist of rejections.
    /// [`super::steps`] and [`super::views`] record the steps that are completed.
    None,
    /// Those of the client.
    Requests,
    /// Those of the server.
    Replies,
}

impl ProgressSign {
    /// `path` is the path of the method's URL.
    fn of_method(path: &str) -> Self {
        match path {
            "/modalcast.v1.StepService/DriveScene" | "/modalcast.v1.ViewService/DrawViews" => Self::None,
            "/modalcast.v1.SceneService/UploadScene" | "/modalcast.v1.SceneService/UploadArrays" => Self::Requests,
            _ if path.starts_with("/grpc.") => Self::None,
            _ => Self::Replies,
        }
    }
}

impl OpenCalls {
    pub(super) fn is_empty(&self) -> bool {
        self.count.load(Ordering::Relaxed) == 0
    }

    pub(super) fn has_received_request(&self) -> bool {
        self.has_received_request.load(Ordering::Relaxed)
    }
}

impl CountedCall {
    /// A new call of the method with this path, on the connection that has the permit.
    pub(super) fn new(calls: &Arc<OpenCalls>, permit: &PermitHandle, path: &str) -> Arc<Self> {
        let (calls, permit, progress) = (Arc::clone(calls), permit.clone(), ProgressSign::of_method(path));
        Arc::new(Self { calls, is_counted: AtomicBool::new(false), permit, progress })
    }

    /// Records that a message of the client has been received completely.
    pub(super) fn receive_message(&self) {
        if !self.is_counted.swap(true, Ordering::Relaxed) {
            self.calls.count.fetch_add(1, Ordering::Relaxed);
            self.calls.has_received_request.store(true, Ordering::Relaxed);
        }
        if self.progress == ProgressSign::Requests {
            self.permit.mark_progress();
        }
    }

    /// Records that the connection takes data of a reply.
    pub(super) fn send_data(&self) {
        if self.progress == ProgressSign::Replies {
            self.permit.mark_progress();
        }
    }
}

impl Drop for CountedCall {
    fn drop(&mut self) {
        if self.is_counted.load(Ordering::Relaxed) {
            self.calls.count.fetch_sub(1, Ordering::Relaxed);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn health_and_rejections_are_no_progress() {
        for (path, sign) in [
            ("/grpc.health.v1.Health/Watch", ProgressSign::None),
            ("/grpc.health.v1.Health/Check", ProgressSign::None),
            ("/modalcast.v1.StepService/DriveScene", ProgressSign::None),
            ("/modalcast.v1.SceneService/UploadArrays", ProgressSign::Requests),
            ("/modalcast.v1.FrameService/StreamFrames", ProgressSign::Replies),
            ("/modalcast.v1.SceneService/ListScenes", ProgressSign::Replies),
        ] {
            assert_eq!(ProgressSign::of_method(path), sign, "{path}");
        }
    }
}
