//! Routes calls to services by the first component of their path. A call passes these layers, in this order:
//!
//! 1. [`Authenticator::admit`] finds its credential and checks its role.
//! 2. [`ConnectionInfo::identify`] finds the account to which it counts.
//! 3. [`answer_in_time`] ends it at its timeout, if the service does not.
//! 4. [`interruption_of`] ends it when its credential is revoked or its connection is preempted.
//! 5. [`RequestBody`] counts the bytes of its requests.
//! 6. The service acquires permits of what it uses; see [`crate::admission`].
//! 7. [`replace_body`] counts the bytes of its replies until they are sent.
//! 8. [`CountedReplyBody`] records its replies as progress of the connection.
//! 9. [`InterruptibleBody`] ends a response that has begun, for the reasons of layer 4.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use tonic::body::Body;
use tonic::codegen::http::{Request, Response};
use tonic::codegen::{BoxFuture, Service};
use tonic::server::NamedService;
use tonic::{Code, Status};

use super::authentication::{Authenticator, Denial};
use super::caller::AdmittedCall;
use super::connection::ConnectionInfo;
use super::interruptible_body::{InterruptibleBody, interruption_of};
use super::open_calls::CountedCall;
use super::reply_body::replace_body;
use super::reply_budget::CountedReplyBody;
use super::request_body::{RequestBody, RequestMemory};
use super::status::{internal_fault, to_status, transport_status, unknown_method};
use super::stream::parse_timeout;
use crate::identity::Credential;
use modalcast_model::error::Error;

/// Time by which a service may exceed the timeout of a call, so that its own error arrives first.
const TIMEOUT_MARGIN: Duration = Duration::from_millis(20);

type Route = Arc<dyn Fn(Request<Body>) -> BoxFuture<Response<Body>, Infallible> + Send + Sync>;

/// All services of the server.
#[derive(Clone)]
pub(super) struct Routes {
    by_name: Arc<BTreeMap<&'static str, Route>>,
    authenticator: Arc<Authenticator>,
    max_message_bytes: usize,
}

impl Routes {
    /// `max_message_bytes` is the limit on the messages that the services accept.
    pub(super) fn new(authenticator: Arc<Authenticator>, max_message_bytes: usize) -> Self {
        Self { by_name: Arc::default(), authenticator, max_message_bytes }
    }

    /// Adds a service.
    pub(super) fn with<S>(self, service: S) -> Self
    where
        S: NamedService + Clone + Send + Sync + 'static,
        S: Service<Request<Body>, Response = Response<Body>, Error = Infallible>,
        S::Future: Send + 'static,
    {
        let mut by_name = Arc::unwrap_or_clone(self.by_name);
        let route: Route = Arc::new(move |request| {
            let call = service.clone().call(request);
            Box::pin(async move { call.await.map(replace_body) })
        });
        by_name.insert(S::NAME, route);
        Self { by_name: Arc::new(by_name), ..self }
    }
}

/// tonic itself rejects a call whose only request message is too large. This function adds the details that all other
/// errors have.
fn with_transport_details(response: Response<Body>, max_message_bytes: usize) -> Response<Body> {
    match Status::from_header_map(response.headers()) {
        Some(status) if status.code() == Code::OutOfRange => transport_status(status, max_message_bytes).into_http(),
        _ => response,
    }
}

impl Routes {
    /// Calls the service that the path names, if the caller may. The request has an [`AdmittedCall`] in its extensions.
    pub(super) fn call(&self, mut request: Request<Body>) -> BoxFuture<Response<Body>, Infallible> {
        let name = request.uri().path().split('/').nth(1).unwrap_or_default();
        let Some(route) = self.by_name.get(name).cloned() else {
            return Box::pin(async { Ok(unknown_method().into_http()) });
        };
        let Some(connection) = request.extensions().get::<ConnectionInfo>().cloned() else {
            return Box::pin(async { Ok(internal_fault("expected a connection of this server").into_http()) });
        };
        let credential = match self.authenticator.admit(request.uri().path(), request.headers(), &connection) {
            Ok(credential) => credential,
            Err(Denial { status, delay }) => {
                return Box::pin(async move {
                    tokio::time::sleep(delay).await;
                    Ok(status.into_http())
                });
            }
        };
        let account = match &credential {
            Some(credential) => connection.identify(credential.principal()),
            None => connection.permit.account(),
        };
        let replies = connection.reply.new_call(&account);
        request.extensions_mut().insert(AdmittedCall { credential: credential.clone(), account, replies });
        let timeout = request.headers().get("grpc-timeout");
        let timeout = timeout.and_then(|timeout| parse_timeout(timeout.to_str().ok()?));
        let response = Box::pin(call_within_budgets(route, request, connection, credential));
        let max_message_bytes = self.max_message_bytes;
        Box::pin(async move {
            let response = answer_in_time(timeout, response).await?;
            Ok(with_transport_details(response, max_message_bytes))
        })
    }
}

/// Awaits a response head for the time in the `grpc-timeout` header. Services that know more about their work enforce
/// the timeout themselves, with a more specific message.
async fn answer_in_time(
    timeout: Option<Duration>,
    response: BoxFuture<Response<Body>, Infallible>,
) -> Result<Response<Body>, Infallible> {
    let Some(timeout) = timeout else { return response.await };
    tokio::time::timeout(timeout + TIMEOUT_MARGIN, response).await.unwrap_or_else(|_| {
        let error = Error::Deadline { what: "a reply".into(), ms: timeout.as_millis() as u64 };
        Ok(to_status(error).into_http())
    })
}

/// Calls a service. Request and response count against the budgets of the connection. The response ends when the
/// credential is revoked or the connection is preempted.
async fn call_within_budgets(
    route: Route,
    request: Request<Body>,
    connection: ConnectionInfo,
    credential: Option<Arc<Credential>>,
) -> Result<Response<Body>, Infallible> {
    let memory = RequestMemory::new(&connection.receive);
    let request_memory = memory.clone();
    let call = CountedCall::new(&connection.calls, &connection.permit, request.uri().path());
    let request_call = Arc::clone(&call);
    let limits = connection.receive.limits();
    let request = request.map(|body| Body::new(RequestBody::new(body, request_memory, limits, request_call)));
    let response = tokio::select! {
        response = route(request) => response,
        status = interruption_of(credential.clone(), &connection.permit) => return Ok(status.into_http()),
    };
    memory.release_complete();
    response.map(|response| {
        response.map(|inner| {
            let body = Body::new(CountedReplyBody { inner, call });
            Body::new(InterruptibleBody::new(body, interruption_of(credential, &connection.permit)))
        })
    })
}

#[cfg(test)]
mod tests {
    use std::task::{Context, Poll};

    use super::*;

    /// Never answers.
    #[derive(Clone)]
    struct Silent;

    impl Service<Request<Body>> for Silent {
        type Response = Response<Body>;
        type Error = Infallible;
        type Future = std::future::Pending<Result<Response<Body>, Infallible>>;

        fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
            Poll::Ready(Ok(()))
        }

        fn call(&mut self, _: Request<Body>) -> Self::Future {
            std::future::pending()
        }
    }

    #[tokio::test]
    async fn call_ends_at_its_timeout_though_the_service_does_not_answer() {
        let silent = Silent;
        let route: Route = Arc::new(move |request| Box::pin(silent.clone().call(request)));
        let response = answer_in_time(Some(Duration::from_millis(10)), route(Request::new(Body::empty())));
        let response = tokio::time::timeout(crate::hang_guard::HANG_GUARD, response).await.expect("expected an answer");
        let response = response.expect("expected a response");
        let status = Status::from_header_map(response.headers()).expect("expected a status");
        assert_eq!(status.code(), Code::DeadlineExceeded);
    }
}
