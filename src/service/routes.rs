//! Routes calls to services by the first component of their path.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::sync::Arc;
use std::task::{Context, Poll};

use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http::{Request, Response};
use tonic::codegen::{BoxFuture, Service};
use tonic::server::NamedService;

use super::reply_body::replace_body;

type Route = Arc<dyn Fn(Request<Body>) -> BoxFuture<Response<Body>, Infallible> + Send + Sync>;

/// All services of the server.
#[derive(Clone, Default)]
pub(super) struct Routes {
    by_name: Arc<BTreeMap<&'static str, Route>>,
}

impl Routes {
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
        Self { by_name: Arc::new(by_name) }
    }
}

impl Service<Request<Body>> for Routes {
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<Response<Body>, Infallible>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        let name = request.uri().path().split('/').nth(1).unwrap_or_default();
        match self.by_name.get(name) {
            Some(route) => route(request),
            None => Box::pin(async {
                Ok(Status::unimplemented("expected the path of a service of this server").into_http())
            }),
        }
    }
}
