//! A client of the WebSocket of `proto/websocket.md`, and raw calls over gRPC to compare with.

use std::collections::VecDeque;

use bytes::Bytes;
use futures_util::{SinkExt as _, StreamExt as _};
use http_body_util::{BodyExt as _, Full};
use prost::Message as _;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::tungstenite::protocol::CloseFrame;
use tokio_tungstenite::tungstenite::{Error as WebSocketError, Message};
use tonic::codegen::{Service as _, http};
use tonic::transport::Channel;

use crate::service_harness::{Server, with_timeout};

// Kinds of messages of the client.
pub(crate) const START: u8 = 0;
pub(crate) const MESSAGE: u8 = 1;
pub(crate) const END: u8 = 2;
pub(crate) const CANCEL: u8 = 3;
pub(crate) const CREDIT: u8 = 4;
pub(crate) const SESSION: u8 = 6;
/// The kind of the server's last message of a call.
pub(crate) const STATUS: u8 = 5;

/// Host and port of a server, as text.
pub(crate) fn authority(server: &Server) -> &str {
    server.address.split_once("://").map_or("", |(_, authority)| authority)
}

/// A message of the server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ServerMessage {
    pub(crate) id: u32,
    pub(crate) kind: u8,
    pub(crate) payload: Bytes,
}

impl ServerMessage {
    /// The payload of a STATUS.
    pub(crate) fn status(&self) -> tonic_types::Status {
        assert_eq!(self.kind, STATUS, "{self:?}");
        tonic_types::Status::decode(self.payload.clone()).expect("expected a status")
    }
}

/// The replies and the status of a call.
#[derive(Debug)]
pub(crate) struct CallResult {
    pub(crate) messages: Vec<Vec<u8>>,
    pub(crate) status: tonic_types::Status,
}

/// A detail of an error. An ErrorInfo is decoded, because the entries of its map are encoded in any order.
#[derive(Debug, PartialEq)]
enum Detail {
    Info(tonic_types::pb::ErrorInfo),
    Other { type_url: String, value: Vec<u8> },
}

impl CallResult {
    fn details(&self) -> Vec<Detail> {
        let decode = |type_url: &str, value: &[u8]| match type_url.ends_with("google.rpc.ErrorInfo") {
            true => Detail::Info(tonic_types::pb::ErrorInfo::decode(value).expect("expected an ErrorInfo")),
            false => Detail::Other { type_url: type_url.into(), value: value.into() },
        };
        self.status.details.iter().map(|detail| decode(&detail.type_url, &detail.value)).collect()
    }
}

impl PartialEq for CallResult {
    fn eq(&self, other: &Self) -> bool {
        let texts = |result: &Self| (result.status.code, result.status.message.clone());
        self.messages == other.messages && texts(self) == texts(other) && self.details() == other.details()
    }
}

/// A connection.
pub(crate) struct WebSocketClient {
    pub(crate) stream: WebSocketStream<TcpStream>,
    next_id: u32,
    /// Messages of other calls than the one that was waited for.
    received: VecDeque<ServerMessage>,
}

impl WebSocketClient {
    pub(crate) async fn connect(server: &Server) -> Self {
        let socket = TcpStream::connect(authority(server)).await.expect("expected a connection");
        socket.set_nodelay(true).expect("expected a TCP connection");
        Self::connect_on(socket, server).await
    }

    pub(crate) async fn connect_on(socket: TcpStream, server: &Server) -> Self {
        let stream = handshake(socket, server, &[]).await.expect("expected a handshake");
        Self { stream, next_id: 1, received: VecDeque::new() }
    }

    pub(crate) async fn send_bytes(&mut self, bytes: Vec<u8>) {
        with_timeout(self.stream.send(Message::binary(bytes))).await.expect("expected an open connection");
    }

    pub(crate) async fn send(&mut self, id: u32, kind: u8, payload: &[u8]) {
        self.send_bytes(envelope(id, kind, payload)).await;
    }

    /// Begins a call without a timeout, and returns its id.
    pub(crate) async fn start(&mut self, path: &str) -> u32 {
        let id = self.next_id;
        self.next_id += 1;
        self.send(id, START, &[&[0; 4], path.as_bytes()].concat()).await;
        id
    }

    /// Begins a call with one request.
    pub(crate) async fn start_with(&mut self, path: &str, request: &impl prost::Message) -> u32 {
        let id = self.start(path).await;
        self.send(id, MESSAGE, &request.encode_to_vec()).await;
        self.send(id, END, &[]).await;
        id
    }

    /// The next message of any call. An error means that the connection is closed; it has the close frame, if the
    /// server has sent one.
    async fn receive_any(&mut self) -> Result<ServerMessage, Option<CloseFrame>> {
        loop {
            match with_timeout(self.stream.next()).await {
                Some(Ok(Message::Binary(bytes))) => {
                    let id = u32::from_le_bytes(bytes[..4].try_into().expect("expected an envelope"));
                    return Ok(ServerMessage { id, kind: bytes[4], payload: bytes.slice(5..) });
                }
                Some(Ok(Message::Close(frame))) => return Err(frame),
                Some(Ok(Message::Text(text))) => panic!("expected a binary message, got {text}"),
                Some(Ok(_)) => {}
                Some(Err(_)) | None => return Err(None),
            }
        }
    }

    /// The next message of a call.
    pub(crate) async fn receive(&mut self, id: u32) -> ServerMessage {
        if let Some(index) = self.received.iter().position(|message| message.id == id) {
            return self.received.remove(index).expect("expected the message");
        }
        loop {
            let message = self.receive_any().await.expect("expected an open connection");
            if message.id == id {
                return message;
            }
            self.received.push_back(message);
        }
    }

    /// Receives a call up to its end, and returns credit for every message.
    pub(crate) async fn finish(&mut self, id: u32) -> CallResult {
        let mut messages = Vec::new();
        loop {
            let message = self.receive(id).await;
            match message.kind {
                MESSAGE => {
                    self.send(id, CREDIT, &(message.payload.len() as u32).to_le_bytes()).await;
                    messages.push(message.payload.to_vec());
                }
                CREDIT => {}
                _ => return CallResult { messages, status: message.status() },
            }
        }
    }

    /// Makes a call with one request.
    pub(crate) async fn call(&mut self, path: &str, request: &impl prost::Message) -> CallResult {
        let id = self.start_with(path, request).await;
        self.finish(id).await
    }

    /// Whether a message of a call has arrived before a message of another call that was waited for.
    pub(crate) fn has_received(&self, id: u32) -> bool {
        self.received.iter().any(|message| message.id == id)
    }

    /// As [`Self::has_received`], for the status of the call.
    pub(crate) fn has_received_status(&self, id: u32) -> bool {
        self.received.iter().any(|message| message.id == id && message.kind == STATUS)
    }

    /// Waits for the end of any call, returns credit for every message until then, and returns the status. `None` at
    /// the end of the connection.
    pub(crate) async fn next_end(&mut self) -> Option<tonic_types::Status> {
        loop {
            let message = self.receive_any().await.ok()?;
            match message.kind {
                STATUS => return Some(message.status()),
                MESSAGE => {
                    let credit = (message.payload.len() as u32).to_le_bytes();
                    let bytes = envelope(message.id, CREDIT, &credit);
                    with_timeout(self.stream.send(Message::binary(bytes))).await.ok()?;
                }
                _ => {}
            }
        }
    }

    /// Waits until the server closes the connection, and returns the code of its close frame.
    pub(crate) async fn closed(&mut self) -> Option<u16> {
        loop {
            if let Err(frame) = self.receive_any().await {
                return frame.map(|frame| frame.code.into());
            }
        }
    }
}

fn envelope(id: u32, kind: u8, payload: &[u8]) -> Vec<u8> {
    [&id.to_le_bytes()[..], &[kind], payload].concat()
}

/// Makes the handshake of a WebSocket with further headers.
pub(crate) async fn handshake<S: AsyncRead + AsyncWrite + Unpin>(
    socket: S,
    server: &Server,
    headers: &[(&'static str, &str)],
) -> Result<WebSocketStream<S>, WebSocketError> {
    let url = format!("ws://{}/websocket", authority(server));
    let mut request = url.into_client_request().expect("expected a valid request");
    request.headers_mut().insert("sec-websocket-protocol", "modalcast.v1".parse().expect("expected a header"));
    for (name, value) in headers {
        request.headers_mut().insert(*name, value.parse().expect("expected a header"));
    }
    Ok(with_timeout(tokio_tungstenite::client_async(request, socket)).await?.0)
}

/// Makes a call with one request over gRPC, and returns its replies as they were sent.
pub(crate) async fn call_grpc(mut channel: Channel, path: &str, request: &impl prost::Message) -> CallResult {
    let message = request.encode_to_vec();
    let message = [&[0], &(message.len() as u32).to_be_bytes()[..], &message].concat();
    let request = http::Request::post(format!("http://server{path}"))
        .header("content-type", "application/grpc")
        .header("te", "trailers")
        .body(tonic::body::Body::new(Full::new(Bytes::from(message))))
        .expect("expected a valid request");
    std::future::poll_fn(|cx| channel.poll_ready(cx)).await.expect("expected an open connection");
    let response = with_timeout(channel.call(request)).await.expect("expected a response");
    let head_status = tonic::Status::from_header_map(response.headers());
    let body = with_timeout(response.into_body().collect()).await.expect("expected a complete body");
    let status = head_status.or_else(|| tonic::Status::from_header_map(body.trailers()?)).expect("expected a status");
    let mut rest = body.to_bytes();
    let mut messages = Vec::new();
    while !rest.is_empty() {
        let length = u32::from_be_bytes(rest[1..5].try_into().expect("expected a prefix")) as usize;
        messages.push(rest[5..][..length].to_vec());
        rest = rest.slice(5 + length..);
    }
    let without_details = || {
        let (code, message) = (status.code() as i32, status.message().to_owned());
        tonic_types::Status { code, message, details: Vec::new() }
    };
    let status = match status.details() {
        [] => without_details(),
        details => tonic_types::Status::decode(details).expect("expected a status"),
    };
    CallResult { messages, status }
}
