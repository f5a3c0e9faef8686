//! Serves gRPC calls over a WebSocket, as `proto/websocket.md` specifies.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use bytes::Bytes;
use futures_util::StreamExt as _;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, Empty, Join, ReadHalf, Sink, WriteHalf};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::task::{AbortHandle, JoinError, JoinSet};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::{Role, WebSocketConfig};

use super::super::authentication::Authenticator;
use super::super::connection::ConnectionInfo;
use super::super::connection_table::{ConnectionSlot, GOAWAY_TIMEOUT};
use super::super::listen::Socket;
use super::super::metered_socket::{Meter as _, MeteredSocket};
use super::super::routes::Routes;
use super::super::status::to_status;
use super::call::{Call, ReplyCredit, status_message};
use super::client_messages::ClientMessages;
use super::close_reason::CloseReason;
use super::envelope::{CallHead, ClientContent, ClientMessage, ENVELOPE_BYTES};
use super::frame_meter::{FrameMeter, Traffic};
use super::outgoing::{Outgoing, write_messages};
use crate::config::Config;
use modalcast_model::error::Error;

/// Limit on the open calls of one connection.
const MAX_CALLS: usize = 32;

/// Number of messages that wait for the socket. Calls wait when it is reached.
const OUTGOING_CAPACITY: usize = 32;

/// Size of the library's buffer for received bytes.
const READ_BUFFER_BYTES: usize = 16 << 10;

/// Size above which the library writes its buffer to the socket.
const WRITE_BUFFER_BYTES: usize = 32 << 10;

/// Time within which the client must take the close frame and close its side.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);

/// Limits of a WebSocket connection.
#[derive(Debug, Clone, Copy)]
pub(super) struct WebSocketLimits {
    max_message_bytes: usize,
    first_request_timeout: Duration,
    keepalive_interval: Duration,
    keepalive_timeout: Duration,
}

impl WebSocketLimits {
    pub(super) fn new(config: &Config) -> Self {
        Self {
            max_message_bytes: config.message_bytes + ENVELOPE_BYTES,
            first_request_timeout: config.first_request_timeout,
            keepalive_interval: config.keepalive_interval,
            keepalive_timeout: config.keepalive_timeout,
        }
    }

    fn library_settings(&self) -> WebSocketConfig {
        WebSocketConfig::default()
            .read_buffer_size(READ_BUFFER_BYTES)
            .write_buffer_size(WRITE_BUFFER_BYTES)
            .max_message_size(Some(self.max_message_bytes))
            .max_frame_size(Some(self.max_message_bytes))
    }
}

/// The socket from which a [`Reader`] reads. Answers that the library writes to it are dropped, because a [`Writer`]
/// sends them.
type ReadSocket = MeteredSocket<Join<ReadHalf<Socket>, Sink>, FrameMeter>;

/// Sends messages. Separate from the reader, so that the reader can be replaced.
type Writer = WebSocketStream<Join<Empty, WriteHalf<Socket>>>;

/// Receives messages.
struct Reader {
    /// `None` only while it is replaced.
    stream: Option<WebSocketStream<ReadSocket>>,
    settings: WebSocketConfig,
}

impl Reader {
    async fn new(socket: ReadSocket, settings: WebSocketConfig) -> Self {
        Self { stream: Some(new_stream(socket, settings).await), settings }
    }

    /// The next message. `None` at the end of the connection. Cancel-safe.
    async fn next(&mut self) -> Result<Option<Message>, Option<CloseReason>> {
        let Some(stream) = &mut self.stream else { return Ok(None) };
        let message = stream.next().await.transpose().map_err(CloseReason::of_read_error)?;
        // The library has delivered all that it has read, so that its buffer can be replaced.
        if matches!(message, Some(Message::Binary(_))) && stream.get_mut().meter.take_boundary() {
            // No task switch between the two statements: creating a stream never waits.
            if let Some(stream) = self.stream.take() {
                self.stream = Some(new_stream(stream.into_inner(), self.settings).await);
            }
        }
        Ok(message)
    }
}

async fn new_stream<S>(socket: S, settings: WebSocketConfig) -> WebSocketStream<S>
where
    S: tokio::io::AsyncRead + tokio::io::AsyncWrite + Unpin,
{
    WebSocketStream::from_raw_socket(socket, Role::Server, Some(settings)).await
}

/// Serves a WebSocket after its handshake, until it ends or the server closes it. `first_bytes` have been received with
/// the handshake.
pub(super) async fn serve_websocket(
    socket: Socket,
    first_bytes: Bytes,
    routes: Routes,
    authenticator: Arc<Authenticator>,
    info: ConnectionInfo,
    slot: &ConnectionSlot,
    limits: WebSocketLimits,
) {
    let traffic = Arc::<Traffic>::default();
    let mut meter = FrameMeter::new(&info.receive, Arc::clone(&traffic));
    // A `MeteredSocket` does not check its prefix, so these bytes are counted here.
    if meter.receive(&first_bytes).is_err() {
        return;
    }
    let preempted = info.receive.preempted();
    let (read_half, write_half) = tokio::io::split(socket);
    let read_socket = MeteredSocket::new(tokio::io::join(read_half, tokio::io::sink()), first_bytes, meter);
    let mut reader = Reader::new(read_socket, limits.library_settings()).await;
    let write_socket = tokio::io::join(tokio::io::empty(), write_half);
    let mut writer = new_stream(write_socket, limits.library_settings()).await;
    let (outgoing, mut queue) = mpsc::channel(OUTGOING_CAPACITY);
    let keep_alive = keep_alive(&traffic, outgoing.clone(), limits);
    let calls = Calls::new(routes, authenticator, info, outgoing);
    let reason = {
        let mut write = std::pin::pin!(write_messages(&mut writer, &mut queue, &traffic.sent));
        let reason = tokio::select! {
            reason = calls.serve(&mut reader, slot, limits.first_request_timeout) => reason,
            _ = &mut write => None,
            () = keep_alive => None,
            error = preempted => Some(CloseReason::receive_budget(&error)),
        };
        if reason == Some(CloseReason::going_away()) {
            // Write the last messages of the calls.
            tokio::time::timeout(GOAWAY_TIMEOUT, write).await.ok();
        }
        reason
    };
    if let Some(reason) = reason {
        tracing::debug!(%reason, "a WebSocket is closed");
        tokio::time::timeout(CLOSE_TIMEOUT, close(writer, reader, reason)).await.ok();
    }
}

/// Sends a close frame and waits until the client has closed its side. Without the wait, unread bytes of the client
/// could reset the connection before the client has read the frame.
async fn close(mut writer: Writer, reader: Reader, reason: CloseReason) {
    writer.close(Some(reason.into_frame())).await.ok();
    let mut write_socket = writer.into_inner();
    write_socket.shutdown().await.ok();
    let Some(stream) = reader.stream else { return };
    let mut socket = stream.into_inner().socket;
    let mut buffer = [0; 4096];
    while let Ok(1..) = socket.read(&mut buffer).await {}
}

/// Sends a ping when nothing has been received for the keepalive interval. Ends if nothing is received in time after
/// the ping.
async fn keep_alive(traffic: &Traffic, outgoing: mpsc::Sender<Outgoing>, limits: WebSocketLimits) {
    let is_unchanged = async |duration| {
        let before = traffic.received.load(Ordering::Relaxed);
        tokio::time::sleep(duration).await;
        traffic.received.load(Ordering::Relaxed) == before
    };
    loop {
        if !is_unchanged(limits.keepalive_interval).await {
            continue;
        }
        // If the queue is full, the client does not read, and the ping would not arrive.
        outgoing.try_send(Outgoing::Ping).ok();
        if is_unchanged(limits.keepalive_timeout).await {
            return;
        }
    }
}

/// An open call.
struct OpenCall {
    messages: Arc<ClientMessages>,
    credit: Arc<ReplyCredit>,
    task: AbortHandle,
}

/// The calls of a connection. Dropping them cancels them.
struct Calls {
    routes: Routes,
    authenticator: Arc<Authenticator>,
    info: ConnectionInfo,
    outgoing: mpsc::Sender<Outgoing>,
    /// Calls whose status is not queued yet, and ended calls that are not removed yet.
    open: HashMap<u32, OpenCall>,
    tasks: JoinSet<()>,
    permits: Arc<Semaphore>,
    /// The largest id of a START.
    last_id: Option<u32>,
    /// No more calls are accepted.
    is_retiring: bool,
}

impl Calls {
    fn new(
        routes: Routes,
        authenticator: Arc<Authenticator>,
        info: ConnectionInfo,
        outgoing: mpsc::Sender<Outgoing>,
    ) -> Self {
        Self {
            routes,
            authenticator,
            info,
            outgoing,
            open: HashMap::new(),
            tasks: JoinSet::new(),
            permits: Arc::new(Semaphore::new(MAX_CALLS)),
            last_id: None,
            is_retiring: false,
        }
    }

    /// Handles messages of the client. Returns the reason to close the connection, or `None` if it has ended.
    async fn serve(
        mut self,
        reader: &mut Reader,
        slot: &ConnectionSlot,
        first_request_timeout: Duration,
    ) -> Option<CloseReason> {
        let mut overdue = std::pin::pin!(slot.first_request_overdue(first_request_timeout));
        loop {
            let handled = tokio::select! {
                message = reader.next() => match message {
                    Ok(Some(message)) => self.receive(message).await,
                    Ok(None) => return None,
                    Err(reason) => return reason,
                },
                Some(ended) = self.tasks.join_next() => check_ended(&ended),
                () = slot.retired(), if !self.is_retiring => {
                    self.is_retiring = true;
                    Ok(())
                }
                () = &mut overdue => Err(CloseReason::policy("expected a request in time")),
            };
            if let Err(reason) = handled {
                return Some(reason);
            }
            if self.is_retiring && self.tasks.is_empty() {
                return Some(CloseReason::going_away());
            }
        }
    }

    async fn receive(&mut self, message: Message) -> Result<(), CloseReason> {
        let message = match message {
            Message::Binary(bytes) => ClientMessage::parse(bytes)?,
            Message::Text(_) => return Err(CloseReason::text_message()),
            Message::Close(_) => return Err(CloseReason::of_client()),
            Message::Ping(payload) => {
                self.outgoing.send(Outgoing::Pong(payload)).await.ok();
                return Ok(());
            }
            Message::Pong(_) | Message::Frame(_) => return Ok(()),
        };
        let id = message.id;
        match message.content {
            ClientContent::Start(head) => return self.start(id, head).await,
            ClientContent::Session(token) => return self.set_session(&token).await,
            _ => {}
        }
        if self.last_id.is_none_or(|last_id| id > last_id) {
            return Err(CloseReason::invalid_id("the id of a START", id));
        }
        // Messages of calls that have ended are ignored.
        let Some(call) = self.open.get(&id) else { return Ok(()) };
        match message.content {
            ClientContent::Start(_) | ClientContent::Session(_) => {}
            ClientContent::Message(message) => call.messages.push(message)?,
            ClientContent::End => call.messages.complete(),
            ClientContent::Credit(bytes) => call.credit.add(bytes),
            ClientContent::Cancel => {
                call.task.abort();
                self.open.remove(&id);
            }
        }
        Ok(())
    }

    /// Gives later calls the rights of a session.
    async fn set_session(&mut self, token: &str) -> Result<(), CloseReason> {
        let Some(credential) = self.authenticator.directory().viewer_sessions().find(token) else {
            self.authenticator.delay_wrong_token().await;
            return Err(CloseReason::unknown_session());
        };
        self.info.begin_session(token, credential);
        Ok(())
    }

    async fn start(&mut self, id: u32, head: CallHead) -> Result<(), CloseReason> {
        if let Some(last_id) = self.last_id.filter(|last_id| id <= *last_id) {
            return Err(CloseReason::invalid_id(&format!("an id above {last_id}"), id));
        }
        self.last_id = Some(id);
        self.open.retain(|_, call| !call.task.is_finished());
        let permit = match self.acquire() {
            Ok(permit) => permit,
            Err(error) => {
                self.outgoing.send(status_message(id, &to_status(error))).await.ok();
                return Ok(());
            }
        };
        // Cancelled calls that have not ended yet are bounded, too.
        while self.tasks.len() >= 2 * MAX_CALLS {
            if let Some(ended) = self.tasks.join_next().await {
                check_ended(&ended)?;
            }
        }
        let (messages, credit) = (ClientMessages::new(&self.info.receive), ReplyCredit::new());
        let (outgoing, shared_messages) = (self.outgoing.clone(), Arc::clone(&messages));
        let call = Call { id, head, messages: shared_messages, credit: Arc::clone(&credit), outgoing, permit };
        let task = self.tasks.spawn(call.run(self.routes.clone(), self.info.clone()));
        self.open.insert(id, OpenCall { messages, credit, task });
        Ok(())
    }

    fn acquire(&self) -> Result<OwnedSemaphorePermit, Error> {
        if self.is_retiring {
            return Err(Error::ShuttingDown);
        }
        let limit = Error::LimitReached { objects: "calls of one WebSocket connection", limit: MAX_CALLS };
        Arc::clone(&self.permits).try_acquire_owned().map_err(|_| limit)
    }
}

fn check_ended(ended: &Result<(), JoinError>) -> Result<(), CloseReason> {
    match ended {
        Err(error) if error.is_panic() => Err(CloseReason::internal()),
        _ => Ok(()),
    }
}
