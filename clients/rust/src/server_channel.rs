//! The connection of a client, which sends the client's token with every call.

use std::task::{Context, Poll};

use tonic::body::Body;
use tonic::codegen::Service;
use tonic::codegen::http::{HeaderValue, Request, Response, header};
use tonic::transport::Channel;

/// A connection for generated clients.
#[derive(Debug, Clone)]
pub(crate) struct ServerChannel {
    pub(crate) channel: Channel,
    /// The value of the header `authorization`.
    pub(crate) authorization: Option<HeaderValue>,
}

impl Service<Request<Body>> for ServerChannel {
    type Response = Response<Body>;
    type Error = tonic::transport::Error;
    type Future = <Channel as Service<Request<Body>>>::Future;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        self.channel.poll_ready(context)
    }

    fn call(&mut self, mut request: Request<Body>) -> Self::Future {
        if let Some(authorization) = &self.authorization {
            request.headers_mut().insert(header::AUTHORIZATION, authorization.clone());
        }
        self.channel.call(request)
    }
}
