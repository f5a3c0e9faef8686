//! Memory that a server on the same machine shares with this client. `SharedRange` in `common.proto` documents the
//! protocol. A connection has slots, which are pieces of memory of equal size. Every call uses a connection of its own,
//! and leaves it to a later call if all of its slots were returned.

mod steps;

use std::io::{self, IoSliceMut};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd as _, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use memmap2::{MmapOptions, MmapRaw};
use modalcast_proto::v1;
use rustix::fs::{SealFlags, fcntl_get_seals, fstat};
use rustix::net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, SendFlags, recv, recvmsg, send};
use tokio::io::Interest;
use tokio::net::UnixStream;
use tonic::Request;
use tonic::metadata::MetadataValue;

use crate::error::{Error, Result, malformed_reply};

pub(crate) use self::steps::StepMemory;

/// Version of the handshake.
const HANDSHAKE_VERSION: u32 = 1;

/// Size of the first message of the server: version, size of a slot, number of slots and 0 as u32, and the token.
const HANDSHAKE_BYTES: usize = 32;

/// Metadata key of a call that uses shared memory. The value is the token of a connection.
const TOKEN_KEY: &str = "modalcast-shared-memory-bin";

/// Time limit of a connection attempt.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// Limit on the memory of one connection in bytes.
const MAX_MEMORY_BYTES: u64 = 1 << 30;

/// Limit on the connections that wait for a call.
const MAX_IDLE_CONNECTIONS: usize = 4;

/// Opens connections for shared memory.
#[derive(Debug)]
pub(crate) struct SharedMemory {
    /// The Unix socket of the server.
    path: PathBuf,
    /// Connections that calls have left. All of their slots are free.
    idle: Mutex<Vec<Arc<MemoryConnection>>>,
}

/// The shared memory of one call, if the client uses it.
#[derive(Debug, Default)]
pub(crate) struct CallMemory(Option<PooledConnection>);

/// A connection, and the pool to which the call returns it.
#[derive(Debug)]
struct PooledConnection {
    connection: Arc<MemoryConnection>,
    pool: Arc<SharedMemory>,
}

/// A connection with its slots.
#[derive(Debug)]
struct MemoryConnection {
    /// Slots that the server fills.
    replies: MmapRaw,
    /// Slots that this client fills.
    requests: MmapRaw,
    slot_bytes: usize,
    slot_count: usize,
    token: [u8; 16],
    socket: UnixStream,
    /// Number of received slots that were not returned.
    used_slots: AtomicUsize,
}

/// Data in a slot. Dropping this returns the slot to the server.
struct SharedData {
    connection: Arc<MemoryConnection>,
    slot: u32,
    bytes: usize,
}

impl SharedMemory {
    /// Opens a first connection to the socket at `path`.
    ///
    /// # Errors
    /// `Connect` if no server answers there, or its memory is not sealed.
    pub(crate) async fn connect(path: &Path) -> Result<Arc<Self>> {
        let first = MemoryConnection::connect(path).await?;
        Ok(Arc::new(Self { path: path.to_owned(), idle: Mutex::new(vec![Arc::new(first)]) }))
    }

    /// The memory of a new call.
    ///
    /// # Errors
    /// As for [`Self::connect`].
    pub(crate) async fn acquire(self: &Arc<Self>) -> Result<CallMemory> {
        // Drops the connections that the server has closed.
        let idle = std::iter::from_fn(|| self.idle().pop()).find(|connection| connection.is_open());
        let connection = match idle {
            Some(connection) => connection,
            None => Arc::new(MemoryConnection::connect(&self.path).await?),
        };
        Ok(CallMemory(Some(PooledConnection { connection, pool: Arc::clone(self) })))
    }

    fn idle(&self) -> std::sync::MutexGuard<'_, Vec<Arc<MemoryConnection>>> {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl CallMemory {
    /// A request that tells the server to use this memory.
    pub(crate) fn request<T>(&self, message: T) -> Request<T> {
        let mut request = Request::new(message);
        if let Some(PooledConnection { connection, .. }) = &self.0 {
            request.metadata_mut().insert_bin(TOKEN_KEY, MetadataValue::from_bytes(&connection.token));
        }
        request
    }

    /// The memory for the values of steps, if the client uses shared memory.
    pub(crate) fn into_step_memory(self) -> Option<StepMemory> {
        self.0.map(|pooled| StepMemory::new(pooled.connection))
    }

    /// The data of a chunk, which are in `data` or in a slot. A slot returns to the server when the last reference to
    /// its data is dropped.
    ///
    /// # Errors
    /// `Malformed` if the range is not in the memory of this call.
    pub(crate) fn data(&self, data: Bytes, shared: Option<v1::SharedRange>) -> Result<Bytes> {
        let Some(v1::SharedRange { slot, bytes }) = shared else { return Ok(data) };
        let (slot_count, slot_bytes) =
            self.0.as_ref().map_or((0, 0), |pooled| (pooled.connection.slot_count, pooled.connection.slot_bytes));
        match &self.0 {
            Some(pooled) if (slot as usize) < slot_count && bytes as usize <= slot_bytes => {
                pooled.connection.used_slots.fetch_add(1, Ordering::Relaxed);
                let connection = Arc::clone(&pooled.connection);
                Ok(Bytes::from_owner(SharedData { connection, slot, bytes: bytes as usize }))
            }
            _ => {
                let expected = format!("at most {slot_bytes} bytes in one of {slot_count} slots");
                Err(malformed_reply("chunk.shared", expected, format!("{bytes} bytes in slot {slot}")))
            }
        }
    }

    /// Leaves the memory to a later call. The call has ended with OK, and all of its messages were read.
    pub(crate) fn release(&mut self) {
        let Some(PooledConnection { connection, pool }) = self.0.take() else { return };
        let mut idle = pool.idle();
        if connection.used_slots.load(Ordering::Acquire) == 0 && idle.len() < MAX_IDLE_CONNECTIONS {
            idle.push(connection);
        }
    }
}

impl MemoryConnection {
    async fn connect(path: &Path) -> Result<Self> {
        let connect_error = |reason: String| Error::Connect { url: path.display().to_string(), reason };
        let connect = tokio::time::timeout(CONNECT_TIMEOUT, Self::open(path));
        let result = connect.await.map_err(|_| connect_error("the server does not answer".into()))?;
        result.map_err(|error| connect_error(error.to_string()))
    }

    async fn open(path: &Path) -> io::Result<Self> {
        let socket = UnixStream::connect(path).await?;
        let receive = || receive_with_files(socket.as_fd());
        let (message, [reply_file, request_file]) = socket.async_io(Interest::READABLE, receive).await?;
        let (numbers, token) = message.split_at(16);
        let number = |index: usize| u32::from_le_bytes(std::array::from_fn(|byte| numbers[4 * index + byte]));
        let [version, slot_bytes, slot_count] = [0, 1, 2].map(number);
        let invalid = |expected: String| io::Error::new(io::ErrorKind::InvalidData, format!("expected {expected}"));
        if version != HANDSHAKE_VERSION {
            return Err(invalid(format!("version {HANDSHAKE_VERSION} of shared memory, got {version}")));
        }
        let memory_bytes = u64::from(slot_bytes) * u64::from(slot_count);
        if !(1..=MAX_MEMORY_BYTES).contains(&memory_bytes) {
            return Err(invalid(format!("1 to {MAX_MEMORY_BYTES} bytes of shared memory, got {memory_bytes}")));
        }
        for file in [&reply_file, &request_file] {
            let file_bytes = fstat(file)?.st_size;
            if u64::try_from(file_bytes).map_or(true, |file_bytes| file_bytes < memory_bytes) {
                return Err(invalid(format!("a file of {memory_bytes} bytes, got {file_bytes}")));
            }
            // Without this seal, the server could shrink the file, and an access to the memory would then end this
            // process.
            if !fcntl_get_seals(file)?.contains(SealFlags::SHRINK) {
                return Err(invalid("a file that is sealed against a smaller size, got another one".into()));
            }
        }
        let mut mapping = MmapOptions::new();
        mapping.len(memory_bytes as usize);
        Ok(Self {
            replies: mapping.map_raw_read_only(&reply_file)?,
            requests: mapping.map_raw(&request_file)?,
            slot_bytes: slot_bytes as usize,
            slot_count: slot_count as usize,
            token: std::array::from_fn(|byte| token[byte]),
            socket,
            used_slots: AtomicUsize::new(0),
        })
    }

    /// Whether the server has not closed the connection. It sends nothing after the handshake.
    fn is_open(&self) -> bool {
        let received = recv(&self.socket, &mut [0_u8; 1], RecvFlags::PEEK | RecvFlags::DONTWAIT);
        matches!(received, Err(rustix::io::Errno::AGAIN))
    }
}

/// Receives the first message of the server and its two files.
fn receive_with_files(socket: BorrowedFd<'_>) -> io::Result<([u8; HANDSHAKE_BYTES], [OwnedFd; 2])> {
    let mut message = [0; HANDSHAKE_BYTES];
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(2))];
    let mut control = RecvAncillaryBuffer::new(&mut space);
    let received = recvmsg(socket, &mut [IoSliceMut::new(&mut message)], &mut control, RecvFlags::CMSG_CLOEXEC)?;
    let files = control.drain().filter_map(|message| match message {
        RecvAncillaryMessage::ScmRights(files) => Some(files),
        _ => None,
    });
    match <[OwnedFd; 2]>::try_from(files.flatten().collect::<Vec<_>>()) {
        Ok(files) if received.bytes == HANDSHAKE_BYTES => Ok((message, files)),
        _ if received.bytes == 0 => {
            let reason = "the server closed the connection: it has too many connections, or it runs as another user";
            Err(io::Error::new(io::ErrorKind::ConnectionReset, reason))
        }
        _ => Err(io::Error::new(io::ErrorKind::InvalidData, "expected the handshake of a modalcast server")),
    }
}

impl AsRef<[u8]> for SharedData {
    fn as_ref(&self) -> &[u8] {
        // SAFETY: `CallMemory::data` has checked that the range is within the slot and the slot within the mapping. The
        // file cannot shrink, because it is sealed. Only the server, which runs as the same user, can write to the
        // memory. It does not write to a slot until the slot is returned, which the drop of `self` does.
        unsafe {
            let start = self.connection.replies.as_ptr().add(self.slot as usize * self.connection.slot_bytes);
            std::slice::from_raw_parts(start, self.bytes)
        }
    }
}

impl Drop for SharedData {
    fn drop(&mut self) {
        // The socket has capacity for the numbers of all slots. An error means that the server has closed it.
        send(&self.connection.socket, &self.slot.to_le_bytes(), SendFlags::NOSIGNAL | SendFlags::DONTWAIT).ok();
        self.connection.used_slots.fetch_sub(1, Ordering::Release);
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use std::io::IoSlice;

    use rustix::fs::{MemfdFlags, fcntl_add_seals, ftruncate, memfd_create};
    use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, sendmsg};
    use tokio::net::UnixListener;

    use super::*;

    const SLOT_BYTES: u32 = 100;
    const SLOT_COUNT: u32 = 3;

    /// A handshake of a server, and the size and seals of its file.
    pub(crate) struct Handshake {
        pub(crate) numbers: [u32; 4],
        pub(crate) file_bytes: u64,
        pub(crate) seals: SealFlags,
    }

    impl Default for Handshake {
        fn default() -> Self {
            let numbers = [HANDSHAKE_VERSION, SLOT_BYTES, SLOT_COUNT, 0];
            Self { numbers, file_bytes: 300, seals: SealFlags::SHRINK }
        }
    }

    /// A server that sends its handshake to each client, and collects the slots that the clients return.
    pub(crate) struct FakeServer {
        folder: tempfile::TempDir,
        listener: UnixListener,
        /// The file for the slots of replies, and also for those of steps.
        pub(crate) file: OwnedFd,
        handshake: Handshake,
    }

    impl FakeServer {
        pub(crate) fn start(handshake: Handshake) -> Self {
            let folder = tempfile::tempdir().expect("expected a folder");
            let listener = UnixListener::bind(folder.path().join("socket")).expect("expected a socket");
            let file = memfd_create("test", MemfdFlags::ALLOW_SEALING).expect("expected a file");
            ftruncate(&file, handshake.file_bytes).expect("expected a size");
            fcntl_add_seals(&file, handshake.seals).expect("expected seals");
            Self { folder, listener, file, handshake }
        }

        fn path(&self) -> PathBuf {
            self.folder.path().join("socket")
        }

        async fn accept(&self) -> UnixStream {
            let (socket, _) = self.listener.accept().await.expect("expected a client");
            let message = [self.handshake.numbers.map(u32::to_le_bytes).as_flattened(), &[9; 16]].concat();
            let files = [self.file.as_fd(), self.file.as_fd()];
            let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(2))];
            let mut control = SendAncillaryBuffer::new(&mut space);
            control.push(SendAncillaryMessage::ScmRights(&files));
            sendmsg(&socket, &[IoSlice::new(&message)], &mut control, SendFlags::empty()).expect("expected a client");
            socket
        }

        /// A connection of a client and the socket of the server.
        pub(crate) async fn connect(&self) -> (Result<Arc<SharedMemory>>, UnixStream) {
            let path = self.path();
            tokio::join!(SharedMemory::connect(&path), self.accept())
        }
    }

    pub(crate) async fn acquire(memory: &Arc<SharedMemory>) -> CallMemory {
        memory.acquire().await.expect("expected memory")
    }

    #[tokio::test]
    async fn slot_returns_when_its_data_are_dropped() {
        use tokio::io::AsyncReadExt as _;
        let server = FakeServer::start(Handshake::default());
        let (memory, mut socket) = server.connect().await;
        let memory = memory.expect("expected memory");
        rustix::io::pwrite(&server.file, b"data", u64::from(2 * SLOT_BYTES)).expect("expected a written file");
        let mut call = acquire(&memory).await;
        let token = call.request(()).metadata().get_bin(TOKEN_KEY).and_then(|value| value.to_bytes().ok());
        assert_eq!(token.expect("expected a token"), &[9; 16][..]);
        let range = v1::SharedRange { slot: 2, bytes: 4 };
        let data = call.data(Bytes::new(), Some(range)).expect("expected data");
        assert_eq!(data, &b"data"[..]);
        drop(data);
        assert_eq!(socket.read_u32_le().await.expect("expected a slot"), 2);
        assert_eq!(call.data(Bytes::from_static(b"sent"), None).expect("expected data"), &b"sent"[..]);
        call.release();
        assert_eq!(memory.idle().len(), 1);
    }

    #[tokio::test]
    async fn only_unused_and_open_memory_is_reused() {
        let server = FakeServer::start(Handshake::default());
        let (memory, first_socket) = server.connect().await;
        let memory = memory.expect("expected memory");
        let mut call = acquire(&memory).await;
        let held = call.data(Bytes::new(), Some(v1::SharedRange { slot: 0, bytes: 1 })).expect("expected data");
        call.release();
        assert_eq!(memory.idle().len(), 0, "expected no reuse of memory with data in use");
        drop((held, first_socket));
        let (mut call, second_socket) = tokio::join!(acquire(&memory), server.accept());
        call.release();
        assert_eq!(memory.idle().len(), 1);
        // The server ends, so the next call needs another connection.
        drop(second_socket);
        let (_call, _third_socket) = tokio::join!(acquire(&memory), server.accept());
        assert_eq!(memory.idle().len(), 0);
    }

    #[tokio::test]
    async fn ranges_outside_the_memory_are_malformed() {
        let server = FakeServer::start(Handshake::default());
        let (memory, _socket) = server.connect().await;
        let call = acquire(&memory.expect("expected memory")).await;
        for (slot, bytes) in [(SLOT_COUNT, 1), (u32::MAX, 1), (0, SLOT_BYTES + 1), (SLOT_COUNT - 1, u32::MAX)] {
            let error = call.data(Bytes::new(), Some(v1::SharedRange { slot, bytes })).expect_err("expected an error");
            assert!(matches!(&error, Error::Malformed { field, .. } if field == "chunk.shared"), "{error}");
        }
        let without_memory = CallMemory::default().data(Bytes::new(), Some(v1::SharedRange { slot: 0, bytes: 1 }));
        assert!(without_memory.is_err());
    }

    #[tokio::test]
    async fn unsafe_handshakes_are_rejected() {
        let with_numbers = |numbers| Handshake { numbers, ..Handshake::default() };
        for (handshake, text) in [
            (with_numbers([2, SLOT_BYTES, SLOT_COUNT, 0]), "version 1"),
            (with_numbers([1, 0, SLOT_COUNT, 0]), "1 to 1073741824 bytes"),
            (with_numbers([1, u32::MAX, u32::MAX, 0]), "1 to 1073741824 bytes"),
            (Handshake { file_bytes: 299, ..Handshake::default() }, "a file of 300 bytes, got 299"),
            (Handshake { seals: SealFlags::GROW, ..Handshake::default() }, "sealed"),
        ] {
            let (memory, _socket) = FakeServer::start(handshake).connect().await;
            let error = memory.expect_err(text).to_string();
            assert!(error.contains(text), "expected '{text}', got '{error}'");
        }
        // A server that closes the connection, and a path without a server.
        let server = FakeServer::start(Handshake::default());
        let path = server.path();
        let (memory, _) = tokio::join!(SharedMemory::connect(&path), async {
            drop(server.listener.accept().await.expect("expected a client"));
        });
        assert!(memory.expect_err("expected an error").to_string().contains("too many"));
        assert!(matches!(SharedMemory::connect(Path::new("/nonexistent")).await, Err(Error::Connect { .. })));
    }
}
