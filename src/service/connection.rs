//! What the server knows about the connection of a call.

use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::connection_table::ConnectionSlot;
use super::open_calls::OpenCalls;
use super::peer::Peer;
use super::receive_budget::{ConnectionReceiveBudget, ReceiveBudget};
use super::reply_budget::{ConnectionReplyBudget, ReplyBudget};
use crate::admission::{Account, Admission, Client, PermitHandle};
use crate::config::Config;
use crate::identity::{Credential, Principal, TokenHash};
use modalcast_model::error::{Error, Result, fault, fault_in};

/// Ratio of the HTTP/2 flow-control windows of a connection and a stream. It is far above the number of streams,
/// because the window of the connection also limits small frames, see [`MAX_DRIVES`].
pub(super) const STREAMS_PER_CONNECTION_WINDOW: u32 = 256;

/// Limit on the step streams of one connection. A stream that blocks is not read, and h2 buffers up to a stream window
/// W of its frames. h2 charges 256 - f bytes for each buffered frame of f bytes, and closes the connection if the
/// charges exceed half of the connection window, 128 W. The smallest frame of a step has f = 9 bytes: 5 bytes of gRPC
/// and a step with nothing but its number. One stream is then charged W / 9 * (256 - 9) = 27.4 W, so four are safe. The
/// parts of a large step are not smaller: a part has a number and says that more follow.
pub(super) const MAX_DRIVES: usize = 4;

/// The budgets that all connections share.
#[derive(Debug, Clone)]
pub(super) struct Budgets {
    receive: Arc<ReceiveBudget>,
    reply: Arc<ReplyBudget>,
    max_connection_pixels: u32,
}

impl Budgets {
    pub(super) fn new(config: &Config, metrics: &Admission) -> Self {
        Self {
            receive: ReceiveBudget::new(config, metrics),
            reply: ReplyBudget::new(config),
            max_connection_pixels: config.connection_pixels,
        }
    }
}

/// A connection, in the extensions of each of its calls.
#[derive(Debug, Clone)]
pub(super) struct ConnectionInfo {
    /// The client to which the permits of calls count.
    client: Client,
    /// Never sent to another client.
    peer: Arc<str>,
    /// The credential of calls without a token.
    pub(super) credential: Option<Arc<Credential>>,
    drive_permits: Arc<Semaphore>,
    /// One permit per pixel of single frames.
    frame_pixels: Arc<Semaphore>,
    /// One permit per pixel of frame streams.
    stream_pixels: Arc<Semaphore>,
    max_pixels: u32,
    pub(super) receive: Arc<ConnectionReceiveBudget>,
    pub(super) reply: Arc<ConnectionReplyBudget>,
    pub(super) calls: Arc<OpenCalls>,
    /// The permit of the connection.
    pub(super) permit: PermitHandle,
}

impl ConnectionInfo {
    /// The connection of a request.
    ///
    /// # Errors
    /// `Fault` when the request did not arrive on a connection of this server.
    pub(super) fn of<T>(request: &tonic::Request<T>) -> Result<Self> {
        let connection = request.extensions().get::<Self>().cloned();
        connection.ok_or_else(|| fault("connection", "expected a connection of this server, got none"))
    }

    pub(super) fn new(
        peer: &Peer,
        credential: Option<Arc<Credential>>,
        budgets: &Budgets,
        slot: &ConnectionSlot,
    ) -> Self {
        Self {
            client: peer.client(),
            peer: peer.name.as_str().into(),
            credential,
            drive_permits: Arc::new(Semaphore::new(MAX_DRIVES)),
            frame_pixels: Arc::new(Semaphore::new(budgets.max_connection_pixels as usize)),
            stream_pixels: Arc::new(Semaphore::new(budgets.max_connection_pixels as usize)),
            max_pixels: budgets.max_connection_pixels,
            receive: budgets.receive.new_connection(&slot.permit().account()),
            reply: budgets.reply.new_connection(Arc::clone(&slot.close)),
            calls: Arc::clone(&slot.calls),
            permit: slot.permit().clone(),
        }
    }

    /// Gives later calls the credential of a viewer's session. They count to this session.
    pub(super) fn begin_session(&mut self, token: &str, credential: Arc<Credential>) {
        self.credential = Some(credential);
        self.client = TokenHash::of(token).map_or(self.client, Client::Session);
    }

    /// The account of a call of a principal. Counts the connection to it, unless it counts to one already.
    pub(super) fn identify(&self, principal: &Principal) -> Account {
        let account = self.account(principal);
        if self.permit.identify(|| account.clone()) {
            self.receive.identify(|| account.clone());
        }
        account
    }

    /// The account of calls of a principal on this connection.
    fn account(&self, principal: &Principal) -> Account {
        Account::new(principal, self.client)
    }

    /// Name of the client, for the log: its address, or its process.
    pub(super) fn peer(&self) -> &str {
        &self.peer
    }

    /// Counts a step stream until the permit is dropped.
    ///
    /// # Errors
    /// `LimitReached` when the connection has [`MAX_DRIVES`] step streams.
    pub(super) fn acquire_drive(&self) -> Result<OwnedSemaphorePermit> {
        let too_many = |_| Error::LimitReached { objects: "streams of steps of one connection", limit: MAX_DRIVES };
        Arc::clone(&self.drive_permits).try_acquire_owned().map_err(too_many)
    }

    /// Waits until `pixels` more pixels of single frames are within the limit of the connection. They count until the
    /// permit is dropped.
    ///
    /// # Errors
    /// `Fault` when the connection no longer exists.
    pub(super) async fn acquire_frame_pixels(&self, pixels: u64) -> Result<OwnedSemaphorePermit> {
        let permits = u32::try_from(pixels).unwrap_or(u32::MAX).min(self.max_pixels);
        Arc::clone(&self.frame_pixels).acquire_many_owned(permits).await.map_err(fault_in("pixel limit"))
    }

    /// Counts the pixels of a frame stream until the permit is dropped.
    ///
    /// # Errors
    /// `LimitReached` when the frame streams of the connection have too many pixels.
    pub(super) fn acquire_stream_pixels(&self, pixels: u64) -> Result<OwnedSemaphorePermit> {
        let objects = "pixels in the frame streams of one connection";
        let too_many = Error::LimitReached { objects, limit: self.max_pixels as usize };
        let permits = u32::try_from(pixels).map_err(|_| too_many.clone())?;
        Arc::clone(&self.stream_pixels).try_acquire_many_owned(permits).map_err(|_| too_many)
    }
}
