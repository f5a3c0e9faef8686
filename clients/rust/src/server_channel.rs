//! The connection of a client, which sends the client's token and metadata with every call.

use std::task::{Context, Poll};

use tonic::body::Body;
use tonic::codegen::Service;
use tonic::codegen::http::{HeaderMap, Request, Response};
use tonic::transport::Channel;

/// A connection for generated clients.
#[derive(Debug, Clone)]
pub(crate) struct ServerChannel {
    pub(crate) channel: Channel,
    /// Sent with every call.
    pub(crate) metadata: HeaderMap,
}

impl Service<Request<Body>> for ServerChannel {
    type Response = Response<Body>;
    type Error = tonic::transport::Error;
    type Future = <Channel as Service<Request<Body>>>::Future;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        self.channel.poll_ready(context)
    }

    fn call(&mut self, mut request: Request<Body>) -> Self::Future {
        for (name, value) in &self.metadata {
            request.headers_mut().append(name, value.clone());
        }
        self.channel.call(request)
    }
}
