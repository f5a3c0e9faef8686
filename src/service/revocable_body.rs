//! The body of a response that ends when the credential of its call is revoked.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use http_body::{Body as HttpBody, Frame, SizeHint};
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::Bytes;
use tonic::codegen::http::HeaderMap;

use super::status::unauthenticated;
use crate::identity::Credential;

/// A body, and the credential that its call needs.
pub(super) struct RevocableBody {
    inner: Body,
    revoked: Pin<Box<dyn Future<Output = ()> + Send>>,
    has_ended: bool,
}

impl RevocableBody {
    pub(super) fn new(inner: Body, credential: Arc<Credential>) -> Self {
        Self { inner, revoked: Box::pin(credential.revoked()), has_ended: false }
    }
}

/// Completes when the credential is revoked; never without one.
pub(super) async fn revoked(credential: Option<Arc<Credential>>) {
    match credential {
        Some(credential) => credential.revoked().await,
        None => std::future::pending().await,
    }
}

/// The status of a call whose credential was revoked.
pub(super) fn revoked_status() -> Status {
    unauthenticated("a valid credential", "one that has been revoked or has expired")
}

impl HttpBody for RevocableBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        if self.has_ended {
            return Poll::Ready(None);
        }
        if self.revoked.as_mut().poll(cx).is_ready() {
            // Dropping the body ends the work of the call.
            (self.inner, self.has_ended) = (Body::empty(), true);
            let mut trailers = HeaderMap::new();
            return Poll::Ready(Some(revoked_status().add_header(&mut trailers).map(|()| Frame::trailers(trailers))));
        }
        Pin::new(&mut self.inner).poll_frame(cx)
    }

    fn is_end_stream(&self) -> bool {
        self.has_ended || self.inner.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.inner.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use http_body_util::BodyExt as _;
    use tonic::Code;

    use super::*;
    use crate::hang_guard::HANG_GUARD;
    use crate::identity::Principal;

    /// Without the revocation, the body would never end.
    #[tokio::test]
    async fn body_ends_with_a_status_when_its_credential_is_revoked() {
        let credential = Credential::new(Arc::new(Principal::owner()), None);
        let pending = http_body_util::StreamBody::new(tokio_stream::pending::<Result<Frame<Bytes>, Status>>());
        let mut body = RevocableBody::new(Body::new(pending), Arc::clone(&credential));
        assert!(tokio::time::timeout(std::time::Duration::ZERO, body.frame()).await.is_err(), "expected no frame yet");
        let end = tokio::spawn(async move {
            let frame = body.frame().await.expect("expected trailers").expect("expected no error");
            (frame.into_trailers().expect("expected trailers"), body.frame().await.is_none())
        });
        credential.revoke();
        let end = tokio::time::timeout(HANG_GUARD, end).await.expect("expected an end");
        let (trailers, has_ended) = end.expect("expected no panic");
        let status = Status::from_header_map(&trailers).expect("expected a status");
        assert_eq!((status.code(), has_ended), (Code::Unauthenticated, true));
    }

    #[tokio::test]
    async fn body_of_a_valid_credential_is_complete() {
        let credential = Credential::new(Arc::new(Principal::owner()), None);
        let body = RevocableBody::new(Body::new(http_body_util::Full::new(Bytes::from_static(b"abc"))), credential);
        let bytes = body.collect().await.expect("expected a body").to_bytes();
        assert_eq!(&bytes[..], b"abc");
    }
}
