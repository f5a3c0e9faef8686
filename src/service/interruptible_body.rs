//! The body of a response that ends when its call is interrupted: its credential is revoked, or its connection preempted.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use http_body::{Body as HttpBody, Frame, SizeHint};
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::Bytes;
use tonic::codegen::http::HeaderMap;

use super::status::{to_status, unauthenticated};
use crate::admission::PermitHandle;
use crate::identity::Credential;

/// The status of a call that is interrupted, once it is.
pub(super) type Interruption = Pin<Box<dyn Future<Output = Status> + Send>>;

/// A body until an interruption.
pub(super) struct InterruptibleBody {
    inner: Body,
    interruption: Interruption,
    has_ended: bool,
}

impl InterruptibleBody {
    pub(super) const fn new(inner: Body, interruption: Interruption) -> Self {
        Self { inner, interruption, has_ended: false }
    }
}

/// The interruption of a call that was admitted with a credential, on the connection that has the permit.
pub(super) fn interruption_of(credential: Option<Arc<Credential>>, permit: &PermitHandle) -> Interruption {
    let preempted = permit.preempted();
    Box::pin(async move {
        tokio::select! {
            () = revoked(credential) => unauthenticated("a valid credential", "one that has been revoked or has expired"),
            error = preempted => to_status(error),
        }
    })
}

/// Completes when the credential is revoked; never without one.
async fn revoked(credential: Option<Arc<Credential>>) {
    match credential {
        Some(credential) => credential.revoked().await,
        None => std::future::pending().await,
    }
}

impl HttpBody for InterruptibleBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        if self.has_ended {
            return Poll::Ready(None);
        }
        if let Poll::Ready(status) = self.interruption.as_mut().poll(cx) {
            // Dropping the body ends the work of the call.
            (self.inner, self.has_ended) = (Body::empty(), true);
            let mut trailers = HeaderMap::new();
            return Poll::Ready(Some(status.add_header(&mut trailers).map(|()| Frame::trailers(trailers))));
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
    use crate::admission::{Account, Admission, Client, Limit};
    use crate::hang_guard::HANG_GUARD;
    use crate::identity::Principal;

    fn account(connection: u64) -> Account {
        Account::anonymous(Client::Connection(connection))
    }

    /// The status at the end of a body that would never end without `interrupt`.
    async fn status_after(interruption: Interruption, interrupt: impl FnOnce()) -> Status {
        let pending = http_body_util::StreamBody::new(tokio_stream::pending::<Result<Frame<Bytes>, Status>>());
        let mut body = InterruptibleBody::new(Body::new(pending), interruption);
        assert!(tokio::time::timeout(std::time::Duration::ZERO, body.frame()).await.is_err(), "expected no frame yet");
        let end = tokio::spawn(async move {
            let frame = body.frame().await.expect("expected trailers").expect("expected no error");
            (frame.into_trailers().expect("expected trailers"), body.frame().await.is_none())
        });
        interrupt();
        let end = tokio::time::timeout(HANG_GUARD, end).await.expect("expected an end");
        let (trailers, has_ended) = end.expect("expected no panic");
        assert!(has_ended);
        Status::from_header_map(&trailers).expect("expected a status")
    }

    #[tokio::test]
    async fn body_ends_when_its_credential_is_revoked_or_its_connection_preempted() {
        let pool = Admission::default().pool(Limit::CONNECTIONS, 1);
        let permit = pool.acquire(&account(1)).expect("expected a permit");
        let credential = Credential::new(Arc::new(Principal::owner()), None);
        let interruption = interruption_of(Some(Arc::clone(&credential)), permit.handle());
        let new = || drop(pool.acquire(&account(2)).expect("expected a permit"));
        let preempted = status_after(interruption, new).await;
        assert_eq!(preempted.code(), Code::ResourceExhausted);
        assert!(preempted.message().contains("another client"), "{}", preempted.message());
        let permit = pool.acquire(&account(3)).expect("expected a permit");
        let interruption = interruption_of(Some(Arc::clone(&credential)), permit.handle());
        let revoked = status_after(interruption, || credential.revoke()).await;
        assert_eq!(revoked.code(), Code::Unauthenticated);
    }

    #[tokio::test]
    async fn body_without_an_interruption_is_complete() {
        let full = Body::new(http_body_util::Full::new(Bytes::from_static(b"abc")));
        let body = InterruptibleBody::new(full, Box::pin(std::future::pending()));
        let bytes = body.collect().await.expect("expected a body").to_bytes();
        assert_eq!(&bytes[..], b"abc");
    }
}
