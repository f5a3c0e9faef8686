//! The sockets that the server listens on: TCP and Unix sockets.

use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::os::unix::fs::{FileTypeExt as _, MetadataExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream, UnixListener, UnixStream};

use crate::config::{Config, ListenAddress, ViewerToken};
use modalcast_model::error::{Error, Result};

/// Bound sockets. Dropping it removes the files of the Unix sockets.
#[derive(Debug, Default)]
pub struct Listener {
    pub(super) sockets: ListeningSockets,
    /// The socket for shared memory, if it is on.
    pub(super) shared_memory: Option<UnixListener>,
    /// The files of the Unix sockets.
    pub(super) files: Vec<SocketFile>,
    urls: Vec<String>,
    /// The addresses of TCP sockets.
    addresses: Vec<SocketAddr>,
    /// `None` if the viewer is off.
    pub(super) viewer_token: Option<ViewerToken>,
}

/// The sockets of a listener.
#[derive(Debug, Default)]
pub(super) struct ListeningSockets(Vec<ListeningSocket>);

#[derive(Debug)]
enum ListeningSocket {
    Tcp(TcpListener),
    Unix(UnixListener),
}

/// The connection of a client.
#[derive(Debug)]
pub(super) enum Socket {
    Tcp(TcpStream),
    Unix(UnixStream),
}

impl Listener {
    /// Binds all sockets of a configuration. Replaces the socket file of a server that no longer runs.
    ///
    /// # Errors
    /// `Unavailable` when an address is in use, does not belong to this machine, or cannot be created; `Fault` when the
    /// system has no random numbers.
    pub(super) async fn bind(config: &Config) -> Result<Self> {
        let mut listener = Self::default();
        if config.viewer {
            let token = config.viewer_token.clone();
            listener.viewer_token = Some(token.map_or_else(ViewerToken::random, Ok)?);
        }
        for address in &config.listen {
            listener.add(address).await.map_err(|error| Error::Unavailable {
                what: "listening address",
                reason: format!("{address}: {error}"),
                remedy: "Set another address with --listen".into(),
            })?;
        }
        if let Some(path) = &config.shared_memory {
            listener.add_shared_memory(path).map_err(|error| Error::Unavailable {
                what: "socket for shared memory",
                reason: format!("{}: {error}", path.display()),
                remedy: "Set another path with --shared-memory".into(),
            })?;
        }
        Ok(listener)
    }

    fn add_shared_memory(&mut self, path: &Path) -> io::Result<()> {
        let (socket, file) = SocketFile::bind(path)?;
        self.shared_memory = Some(socket);
        self.files.push(file);
        Ok(())
    }

    async fn add(&mut self, address: &ListenAddress) -> io::Result<()> {
        let socket = match address {
            ListenAddress::Tcp(address) => {
                let socket = TcpListener::bind(address).await?;
                let bound_address = socket.local_addr()?;
                self.urls.push(format!("http://{bound_address}"));
                self.addresses.push(bound_address);
                ListeningSocket::Tcp(socket)
            }
            ListenAddress::Unix(path) => {
                let (socket, file) = SocketFile::bind(path)?;
                self.urls.push(address.to_string());
                self.files.push(file);
                ListeningSocket::Unix(socket)
            }
        };
        self.sockets.0.push(socket);
        Ok(())
    }

    /// The URLs for clients, in the order of the addresses: `http://IP:PORT` or `unix:PATH`.
    pub fn urls(&self) -> &[String] {
        &self.urls
    }

    /// The addresses that other machines can connect to.
    pub fn remote_addresses(&self) -> impl Iterator<Item = SocketAddr> {
        self.addresses.iter().copied().filter(|address| !address.ip().is_loopback())
    }

    /// The URLs of the viewer for browsers on this machine, in the order of the addresses. Empty if the viewer is off.
    pub fn viewer_urls(&self) -> Vec<String> {
        let Some(path) = self.viewer_url_path() else { return Vec::new() };
        self.local_urls().into_iter().map(|url| url + &path).collect()
    }

    /// The URLs at which programs on this machine reach the TCP sockets, in the order of the addresses.
    pub fn local_urls(&self) -> Vec<String> {
        self.addresses.iter().map(|address| format!("http://{}", local_address(*address))).collect()
    }

    /// The addresses in the viewer's URLs.
    pub fn viewer_addresses(&self) -> impl Iterator<Item = SocketAddr> {
        self.addresses.iter().filter(|_| self.viewer_token.is_some()).map(|address| local_address(*address))
    }

    /// The path and query of the URLs of the viewer. `None` if the viewer is off.
    pub(super) fn viewer_url_path(&self) -> Option<String> {
        self.viewer_token.as_ref().map(|token| format!("/?token={}", token.as_str()))
    }
}

/// The address at which a program on this machine reaches a socket.
fn local_address(address: SocketAddr) -> SocketAddr {
    let ip = match address.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        IpAddr::V6(ip) if ip.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        ip => ip,
    };
    SocketAddr::new(ip, address.port())
}

/// The name of this machine.
pub fn host_name() -> Option<String> {
    rustix::system::uname().nodename().to_str().ok().filter(|name| !name.is_empty()).map(str::to_owned)
}

impl ListeningSockets {
    /// Accepts a connection on any of the sockets, and returns it with the name of its client. Cancel-safe.
    pub(super) async fn accept(&self) -> io::Result<(Socket, String)> {
        let poll_accept = |cx: &mut Context<'_>| {
            let ready = self.0.iter().find_map(|socket| match socket.poll_accept(cx) {
                Poll::Ready(result) => Some(result),
                Poll::Pending => None,
            });
            ready.map_or(Poll::Pending, Poll::Ready)
        };
        std::future::poll_fn(poll_accept).await
    }
}

impl ListeningSocket {
    fn poll_accept(&self, cx: &mut Context<'_>) -> Poll<io::Result<(Socket, String)>> {
        match self {
            Self::Tcp(listener) => listener.poll_accept(cx)?.map(|(stream, peer)| {
                stream.set_nodelay(true)?;
                Ok((Socket::Tcp(stream), peer.to_string()))
            }),
            Self::Unix(listener) => listener.poll_accept(cx)?.map(|(stream, _)| {
                let pid = stream.peer_cred().ok().and_then(|credentials| credentials.pid());
                let peer = pid.map_or_else(|| "unix socket".to_owned(), |pid| format!("process {pid}"));
                Ok((Socket::Unix(stream), peer))
            }),
        }
    }
}

/// The file of a Unix socket. Dropping it removes the file.
#[derive(Debug)]
pub(super) struct SocketFile {
    path: PathBuf,
    /// Device and inode, so that the file of another server at this path is not removed.
    identity: (u64, u64),
}

impl SocketFile {
    /// Binds a socket that only the user of this process can connect to.
    fn bind(path: &Path) -> io::Result<(UnixListener, Self)> {
        check_replaceable(path)?;
        // The socket gets its permissions before its name, and the rename replaces a stale file.
        let temporary_path = path.with_extension(format!("{}.new", std::process::id()));
        let bind = || {
            let listener = UnixListener::bind(&temporary_path)?;
            std::fs::set_permissions(&temporary_path, std::fs::Permissions::from_mode(0o600))?;
            let metadata = std::fs::metadata(&temporary_path)?;
            std::fs::rename(&temporary_path, path)?;
            Ok((listener, Self { path: path.to_owned(), identity: (metadata.dev(), metadata.ino()) }))
        };
        bind().inspect_err(|_| {
            std::fs::remove_file(&temporary_path).ok();
        })
    }
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        let identity = std::fs::symlink_metadata(&self.path).map(|metadata| (metadata.dev(), metadata.ino()));
        if identity.is_ok_and(|identity| identity == self.identity) {
            std::fs::remove_file(&self.path).ok();
        }
    }
}

/// Fails unless `path` is free or is the socket of a server that no longer runs.
fn check_replaceable(path: &Path) -> io::Result<()> {
    let Ok(metadata) = std::fs::symlink_metadata(path) else { return Ok(()) };
    if !metadata.file_type().is_socket() {
        return Err(io::Error::new(io::ErrorKind::AlreadyExists, "expected a free path or a socket, got another file"));
    }
    match std::os::unix::net::UnixStream::connect(path) {
        Ok(_) => Err(io::Error::new(io::ErrorKind::AddrInUse, "another server listens on this socket")),
        Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => Ok(()),
        Err(error) => Err(error),
    }
}

/// Both directions of a socket.
trait Io: AsyncRead + AsyncWrite + Send + Unpin {}

impl<T: AsyncRead + AsyncWrite + Send + Unpin> Io for T {}

impl Socket {
    fn io(&mut self) -> Pin<&mut dyn Io> {
        match self {
            Self::Tcp(stream) => Pin::new(stream),
            Self::Unix(stream) => Pin::new(stream),
        }
    }

    /// The IP address at which the connection arrived. `None` for a Unix socket.
    pub(super) fn local_ip(&self) -> Option<IpAddr> {
        match self {
            Self::Tcp(stream) => stream.local_addr().ok().map(|address| address.ip().to_canonical()),
            Self::Unix(_) => None,
        }
    }
}

impl AsyncRead for Socket {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        self.io().poll_read(cx, buffer)
    }
}

impl AsyncWrite for Socket {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.io().poll_write(cx, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.io().poll_write_vectored(cx, slices)
    }

    fn is_write_vectored(&self) -> bool {
        match self {
            Self::Tcp(stream) => stream.is_write_vectored(),
            Self::Unix(stream) => stream.is_write_vectored(),
        }
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.io().poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.io().poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn stale_socket_is_replaced_and_other_files_are_kept() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let path = folder.path().join("socket");
        let config = Config { listen: vec![ListenAddress::Unix(path.clone())], ..Config::default() };
        // A standard library listener leaves its file, as a killed server does.
        drop(std::os::unix::net::UnixListener::bind(&path).expect("expected a socket"));
        let listener = Listener::bind(&config).await.expect("expected the stale socket to be replaced");
        assert_eq!(std::fs::metadata(&path).expect("expected a file").permissions().mode() & 0o777, 0o600);
        let error = Listener::bind(&config).await.expect_err("expected a socket in use").to_string();
        assert!(error.contains("another server"), "{error}");
        drop(listener);
        assert_eq!(std::fs::read_dir(folder.path()).expect("expected a folder").count(), 0);
        std::fs::write(&path, "text").expect("expected a writable folder");
        assert!(Listener::bind(&config).await.is_err());
        assert_eq!(std::fs::read_to_string(&path).expect("expected the file"), "text");
    }

    /// A server that was replaced does not remove the socket of its successor.
    #[tokio::test]
    async fn only_the_own_socket_file_is_removed() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let path = folder.path().join("socket");
        let config = Config { listen: vec![ListenAddress::Unix(path.clone())], ..Config::default() };
        let first = Listener::bind(&config).await.expect("expected a socket");
        std::fs::remove_file(&path).expect("expected the file");
        let _second = Listener::bind(&config).await.expect("expected a socket");
        drop(first);
        assert!(path.exists());
    }
}
