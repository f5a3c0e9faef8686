//! Memory that clients of the same machine share with the server. `SharedRange` in `common.proto` documents the
//! protocol. There is a Unix socket for each TCP port, and one more if the configuration names one.
//!
//! A connection to that socket owns slots for replies and slots for steps, whose memory is bounded: at most
//! [`crate::admission::Limit::SHARED_MEMORY`] times `2 * SLOT_COUNT * SLOT_BYTES`. Data in slots do not count against the
//! budget of replies. The copied values of a step count as those of a step in several messages. A call without a free
//! slot for a reply waits until its client returns one or the connection ends. The first call that uses a connection
//! binds it to the principal of the call.

mod device_memory;
mod reply_memory;
mod request_memory;
mod slot_pool;

use std::collections::HashMap;
use std::io::{self, IoSlice};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd as _, BorrowedFd, OwnedFd};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

use bytes::Bytes;
use modalcast_proto::v1;
use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, Shutdown, send, sendmsg, shutdown};
use tokio::io::{AsyncReadExt as _, Interest};
use tokio::net::unix::OwnedWriteHalf;
use tokio::net::{UnixListener, UnixStream};
use tokio::task::{JoinHandle, JoinSet};
use tonic::metadata::MetadataMap;

pub(super) use self::device_memory::DeviceMemory;
use self::device_memory::FIRST_DEVICE_SLOT;
use self::reply_memory::{ReplyMemory, SLOT_BYTES, SLOT_COUNT};
use self::request_memory::RequestMemory;
use self::slot_pool::SlotPool;
use super::peer::Peer;
use crate::admission::{Account, Permit, PermitPool};
use crate::engine::lock;
use crate::identity::Principal;
use modalcast_model::error::{Result, invalid};

/// Version of the handshake.
const HANDSHAKE_VERSION: u32 = 1;

/// Metadata key of a call that uses shared memory. The value is the token of a connection.
const TOKEN_KEY: &str = "modalcast-shared-memory-bin";

/// Pause after a failed accept.
const ACCEPT_RETRY_DELAY: Duration = Duration::from_millis(50);

type Token = [u8; 16];

/// The memory of all connections, by their tokens.
#[derive(Debug, Clone, Default)]
pub(super) struct SharedMemory {
    connections: Arc<Mutex<HashMap<Token, Arc<ConnectionMemory>>>>,
}

/// The memory of one connection. It is freed when the connection and all of its calls have ended.
#[derive(Debug)]
struct ConnectionMemory {
    replies: ReplyMemory,
    requests: RequestMemory,
    /// The slots of device memory, if a call has asked for them.
    device_slots: OnceLock<Arc<SlotPool>>,
    /// Returns the slots of `requests` to the client.
    returns: OwnedWriteHalf,
    /// The name of the principal whose calls may use this memory, once there has been a call.
    principal: OnceLock<String>,
}

/// Accepts connections until it is dropped. Then all of them end.
#[derive(Debug)]
pub(super) struct SharedMemoryServer(JoinHandle<()>);

/// The shared memory of one call, if the client has asked for it.
#[derive(Debug, Clone, Default)]
pub(super) struct CallMemory(Option<Arc<ConnectionMemory>>);

impl SharedMemory {
    /// Creates memory for the clients of a socket.
    pub(super) fn serve(&self, listener: UnixListener, permits: PermitPool) -> SharedMemoryServer {
        SharedMemoryServer(tokio::spawn(accept_connections(listener, self.clone(), permits)))
    }

    /// The memory that a call of a principal asks for.
    ///
    /// # Errors
    /// `Invalid` if the metadata have another value than the token of an open connection, or if another principal uses
    /// this connection.
    pub(super) fn find(&self, metadata: &MetadataMap, principal: &Principal) -> Result<CallMemory> {
        let Some(value) = metadata.get_bin(TOKEN_KEY) else { return Ok(CallMemory::default()) };
        let token = value.to_bytes().ok().and_then(|bytes| Token::try_from(&*bytes).ok());
        let connection = token.and_then(|token| lock(&self.connections).get(&token).cloned());
        let own = connection.filter(|connection| connection.belongs_to(principal));
        let unknown = || invalid(TOKEN_KEY, "the token of an open connection for shared memory", "another value");
        own.map(|connection| CallMemory(Some(connection))).ok_or_else(unknown)
    }
}

impl ConnectionMemory {
    /// The memory of a new connection.
    fn new(replies: ReplyMemory, requests: RequestMemory, returns: OwnedWriteHalf) -> Self {
        Self { replies, requests, device_slots: OnceLock::new(), returns, principal: OnceLock::new() }
    }

    /// Takes a slot back from the client.
    ///
    /// # Errors
    /// `InvalidData` if the client does not have this slot.
    fn take_back(&self, slot: u32) -> io::Result<()> {
        match (slot.checked_sub(FIRST_DEVICE_SLOT), self.device_slots.get()) {
            (Some(slot), Some(device_slots)) => device_slots.take_back(slot),
            _ => self.replies.take_back(slot),
        }
    }

    /// Whether the calls of a principal may use this memory. The first principal who asks may.
    fn belongs_to(&self, principal: &Principal) -> bool {
        *self.principal.get_or_init(|| principal.name.clone()) == principal.name
    }
}

impl CallMemory {
    /// Whether the call has shared memory.
    pub(super) const fn is_available(&self) -> bool {
        self.0.is_some()
    }

    /// Moves the data of a chunk to shared memory if the call uses it. Waits for a free slot. Returns `None` and keeps
    /// the data if the chunk must contain them. Cancel-safe.
    pub(super) async fn share(&self, data: &mut Bytes) -> Option<v1::SharedRange> {
        self.0.as_ref()?.replies.lend(data).await
    }

    /// Copies values of a step from shared memory into the step, and returns their slots to the client.
    ///
    /// # Errors
    /// `Invalid` if a range is not in the memory of this call, or the message has the values, too.
    pub(super) fn receive(&self, step: &mut v1::Step) -> Result<()> {
        let q = ("step.shared_q", step.shared_q.take(), &mut step.q);
        let transforms = ("step.shared_transforms", step.shared_transforms.take(), &mut step.transforms);
        let mut result = Ok(());
        for (field, range, values) in [q, transforms] {
            let Some(range) = range else { continue };
            match self.copy(field, range) {
                Ok(copy) if values.is_empty() => *values = copy,
                Ok(_) => result = Err(invalid(field, "values in shared memory or in the message", "both")),
                Err(error) => result = Err(error),
            }
        }
        result
    }

    fn copy(&self, field: &str, range: v1::SharedRange) -> Result<Bytes> {
        let Some(connection) = &self.0 else {
            return Err(invalid(field, "a call with shared memory", "a call without it"));
        };
        let copy = connection.requests.copy(field, range)?;
        // If the client does not read the numbers, it does not get its slots back.
        let number = range.slot.to_le_bytes();
        send(connection.returns.as_ref(), &number, SendFlags::NOSIGNAL | SendFlags::DONTWAIT).ok();
        Ok(copy)
    }
}

impl Drop for SharedMemoryServer {
    fn drop(&mut self) {
        self.0.abort();
    }
}

async fn accept_connections(listener: UnixListener, memory: SharedMemory, permits: PermitPool) {
    // Ends all connections when this task is aborted.
    let mut connections = JoinSet::new();
    loop {
        while connections.try_join_next().is_some() {}
        match listener.accept().await {
            Ok((socket, _)) => match permits.acquire(&account_of(&socket)) {
                Ok(permit) => {
                    connections.spawn(run_connection(socket, memory.clone(), permit));
                }
                Err(error) => tracing::warn!(%error, "a connection for shared memory was closed"),
            },
            Err(error) => {
                tracing::warn!(%error, "a connection for shared memory could not be accepted");
                tokio::time::sleep(ACCEPT_RETRY_DELAY).await;
            }
        }
    }
}

/// The account of a connection: all clients are of the user of the server.
fn account_of(socket: &UnixStream) -> Account {
    let pid = socket.peer_cred().ok().and_then(|credentials| credentials.pid());
    Account::new(&Principal::owner(), Peer::new(String::new(), None, pid).client())
}

async fn run_connection(socket: UnixStream, memory: SharedMemory, permit: Permit) {
    if let Err(error) = serve_memory(socket, &memory, permit).await {
        tracing::warn!(%error, "a connection for shared memory was closed");
    }
}

/// Serves a connection until its client closes it.
///
/// # Errors
/// `PermissionDenied` for a client of another user; `InvalidData` if the client returns a slot that it does not have;
/// errors of the system.
async fn serve_memory(socket: UnixStream, memory: &SharedMemory, permit: Permit) -> io::Result<()> {
    check_user(socket.peer_cred()?.uid())?;
    let (replies, reply_file) = ReplyMemory::new(permit)?;
    let (requests, request_file) = RequestMemory::new()?;
    let mut token = Token::default();
    getrandom::fill(&mut token).map_err(io::Error::other)?;
    let (mut slots, returns) = socket.into_split();
    let registration = Registration::new(memory, token, ConnectionMemory::new(replies, requests, returns));
    send_handshake(slots.as_ref(), token, [reply_file, request_file]).await?;
    loop {
        match slots.read_u32_le().await {
            Ok(slot) => registration.connection.take_back(slot)?,
            Err(error) if is_disconnect(&error) => return Ok(()),
            Err(error) => return Err(error),
        }
    }
}

/// Accepts only the user of this process. The permissions of the socket exclude other users, but not the system
/// administrator.
fn check_user(uid: u32) -> io::Result<()> {
    let own_uid = rustix::process::geteuid().as_raw();
    if uid == own_uid {
        return Ok(());
    }
    let reason = format!("expected a client of the user {own_uid}, got one of the user {uid}");
    Err(io::Error::new(io::ErrorKind::PermissionDenied, reason))
}

fn is_disconnect(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::UnexpectedEof | io::ErrorKind::ConnectionReset)
}

/// Sends the sizes of the memory, its token and its files.
async fn send_handshake(socket: &UnixStream, token: Token, files: [OwnedFd; 2]) -> io::Result<()> {
    let numbers = [HANDSHAKE_VERSION, SLOT_BYTES as u32, SLOT_COUNT as u32, 0].map(u32::to_le_bytes);
    let message = [numbers.as_flattened(), &token].concat();
    let send = || send_with_files(socket.as_fd(), &message, files.each_ref().map(OwnedFd::as_fd));
    // The socket is new, so its buffer has capacity for the whole message.
    match socket.async_io(Interest::WRITABLE, send).await? {
        sent if sent == message.len() => Ok(()),
        _ => Err(io::ErrorKind::WriteZero.into()),
    }
}

fn send_with_files(socket: BorrowedFd<'_>, message: &[u8], files: [BorrowedFd<'_>; 2]) -> io::Result<usize> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(2))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    control.push(SendAncillaryMessage::ScmRights(&files));
    Ok(sendmsg(socket, &[IoSlice::new(message)], &mut control, SendFlags::NOSIGNAL)?)
}

/// A connection that calls can find until this is dropped.
struct Registration<'a> {
    memory: &'a SharedMemory,
    token: Token,
    connection: Arc<ConnectionMemory>,
}

impl<'a> Registration<'a> {
    fn new(memory: &'a SharedMemory, token: Token, connection: ConnectionMemory) -> Self {
        let connection = Arc::new(connection);
        lock(&memory.connections).insert(token, Arc::clone(&connection));
        Self { memory, token, connection }
    }
}

impl Drop for Registration<'_> {
    fn drop(&mut self) {
        lock(&self.memory.connections).remove(&self.token);
        self.connection.replies.close();
        if let Some(device_slots) = self.connection.device_slots.get() {
            device_slots.close();
        }
        // Calls may hold the socket open, but the client learns that the connection has ended.
        shutdown(self.connection.returns.as_ref(), Shutdown::Both).ok();
    }
}

#[cfg(test)]
mod tests {
    use tonic::Code;
    use tonic::metadata::MetadataValue;

    use super::*;
    use crate::admission::Limit;
    use crate::identity::Role;
    use crate::service::status::to_status;

    #[test]
    fn only_the_own_user_is_accepted() {
        let own_uid = rustix::process::geteuid().as_raw();
        assert!(check_user(own_uid).is_ok());
        assert_eq!(check_user(own_uid + 1).map_err(|error| error.kind()), Err(io::ErrorKind::PermissionDenied));
    }

    /// The memory of a connection, and the socket of its client.
    fn new_connection() -> (ConnectionMemory, UnixStream) {
        let (replies, _) = ReplyMemory::new(Permit::for_test(Limit::SHARED_MEMORY)).expect("expected memory");
        let (requests, _) = RequestMemory::new().expect("expected memory");
        let (socket, client) = UnixStream::pair().expect("expected sockets");
        (ConnectionMemory::new(replies, requests, socket.into_split().1), client)
    }

    #[tokio::test]
    async fn slots_of_a_step_return_unless_they_do_not_exist() {
        let (connection, mut client) = new_connection();
        let memory = CallMemory(Some(Arc::new(connection)));
        let range = |slot| Some(v1::SharedRange { slot, bytes: 4 });
        let mut step = v1::Step { shared_q: range(3), shared_transforms: range(0), ..Default::default() };
        memory.receive(&mut step).expect("expected values");
        let zeros = Bytes::from_static(&[0; 4]);
        assert_eq!(step, v1::Step { q: zeros.clone(), transforms: zeros.clone(), ..Default::default() });
        let in_both = v1::Step { q: zeros.clone(), shared_q: range(5), ..Default::default() };
        let unknown = v1::Step { shared_q: range(99), shared_transforms: range(6), ..Default::default() };
        for (mut step, field) in [(in_both, "step.shared_q: "), (unknown, "step.shared_q: ")] {
            let error = memory.receive(&mut step).expect_err("expected an error").to_string();
            assert!(error.starts_with(field), "{error}");
        }
        for slot in [3, 0, 5, 6] {
            assert_eq!(client.read_u32_le().await.expect("expected a slot"), slot);
        }
        let mut step = v1::Step { shared_transforms: range(0), ..Default::default() };
        assert!(CallMemory::default().receive(&mut step).is_err());
        assert!(CallMemory::default().receive(&mut v1::Step::default()).is_ok());
    }

    fn find(memory: &SharedMemory, token: &[u8], principal: &Principal) -> Result<CallMemory, Code> {
        let mut metadata = MetadataMap::new();
        metadata.insert_bin(TOKEN_KEY, MetadataValue::from_bytes(token));
        memory.find(&metadata, principal).map_err(|error| to_status(error).code())
    }

    #[tokio::test]
    async fn memory_belongs_to_the_principal_who_used_it_first() {
        let memory = SharedMemory::default();
        let _registrations = [[7; 16], [8; 16]].map(|token| Registration::new(&memory, token, new_connection().0));
        let anna = Principal { name: "anna".into(), role: Role::Drive };
        assert!(find(&memory, &[7; 16], &anna).is_ok() && find(&memory, &[7; 16], &anna).is_ok());
        assert_eq!(find(&memory, &[7; 16], &Principal::owner()).err(), Some(Code::InvalidArgument));
        assert!(find(&memory, &[8; 16], &Principal::owner()).is_ok());
        assert_eq!(find(&memory, &[8; 16], &anna).err(), Some(Code::InvalidArgument));
    }

    #[tokio::test]
    async fn memory_is_found_by_its_token_while_it_is_registered() {
        let memory = SharedMemory::default();
        let find = |token: &[u8]| find(&memory, token, &Principal::owner());
        let registration = Registration::new(&memory, [7; 16], new_connection().0);
        let call_memory = find(&[7; 16]).expect("expected the memory");
        let mut data = Bytes::from(vec![1; SLOT_BYTES]);
        assert!(call_memory.share(&mut data).await.is_some() && data.is_empty());
        for token in [&[8; 16][..], &[7; 15], &[]] {
            assert_eq!(find(token).err(), Some(Code::InvalidArgument), "{token:?}");
        }
        drop(registration);
        assert_eq!(find(&[7; 16]).err(), Some(Code::InvalidArgument));
        let mut kept = Bytes::from(vec![1; SLOT_BYTES]);
        assert!(call_memory.share(&mut kept).await.is_none() && kept.len() == SLOT_BYTES);
        let no_metadata = memory.find(&MetadataMap::new(), &Principal::owner()).expect("expected no error");
        assert!(no_metadata.share(&mut kept).await.is_none() && kept.len() == SLOT_BYTES);
    }
}
