//! The sockets that the server listens on: TCP and Unix sockets.

use std::collections::BTreeSet;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::os::unix::fs::{DirBuilderExt as _, FileTypeExt as _, MetadataExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream, UnixListener, UnixStream};

use super::authentication::Authenticator;
use super::peer::Peer;
use super::tls::{TlsServer, TlsSocket};
use crate::config::{Config, ListenAddress, PublicUrl, SocketPermissions};
use crate::identity::CertificateName;
use modalcast_model::error::{Error, Result};

/// Bound sockets, and the credentials of their clients. Dropping it removes the files of the Unix sockets.
#[derive(Debug)]
pub struct Listener {
    pub(super) sockets: ListeningSockets,
    /// The sockets for shared memory.
    pub(super) shared_memory: Vec<UnixListener>,
    /// The files of the Unix sockets.
    pub(super) files: Vec<SocketFile>,
    urls: Vec<String>,
    /// The addresses of TCP sockets.
    addresses: Vec<SocketAddr>,
    has_viewer: bool,
    pub(super) authenticator: Arc<Authenticator>,
    /// Encrypts the TCP sockets. `None`: they are plain.
    pub(super) tls: Option<Arc<TlsServer>>,
    pub(super) public_url: Option<PublicUrl>,
    /// The socket of health and metrics, if it is on.
    pub(super) admin: Option<ListeningSockets>,
    admin_url: Option<String>,
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
    Tls(TlsSocket),
    Unix(UnixStream),
}

impl Listener {
    /// Binds all sockets of a configuration. Replaces the socket file of a server that no longer runs.
    ///
    /// # Errors
    /// `Unavailable` when an address is in use, does not belong to this machine, or cannot be created; `InvalidFile` for
    /// the file of principals, and for certificates; `Invalid` for names of certificates; `Fault` when the system has no
    /// random numbers.
    pub(super) async fn bind(config: &Config) -> Result<Self> {
        let mut listener = Self {
            sockets: ListeningSockets::default(),
            shared_memory: Vec::new(),
            files: Vec::new(),
            urls: Vec::new(),
            addresses: Vec::new(),
            has_viewer: config.viewer,
            authenticator: Authenticator::new(config)?,
            tls: None,
            public_url: config.public_url.clone(),
            admin: None,
            admin_url: None,
        };
        if let Some(settings) = &config.tls {
            listener.tls = Some(TlsServer::open(settings, config, own_names(&config.listen))?);
        }
        for address in &config.listen {
            listener.add(address, config.socket_permissions).await.map_err(|error| Error::Unavailable {
                what: "listening address",
                reason: format!("{address}: {error}"),
                remedy: "Set another address with --listen".into(),
            })?;
        }
        if let Some(address) = &config.admin {
            listener.add_admin(address).await.map_err(|error| Error::Unavailable {
                what: "address of health and metrics",
                reason: format!("{address}: {error}"),
                remedy: "Set another address with --admin".into(),
            })?;
        }
        if let Some(folder) = &config.local_sockets {
            listener.add_local_sockets(folder);
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

    /// Adds two sockets for each TCP port, which programs of this user find by the port: one for calls, and one for shared
    /// memory. The server runs without those that cannot be created.
    fn add_local_sockets(&mut self, folder: &Path) {
        let ports: BTreeSet<u16> = self.addresses.iter().map(SocketAddr::port).collect();
        for port in ports {
            let path = folder.join(format!("{port}.sock"));
            let bind = || {
                create_private_folder(folder)?;
                SocketFile::bind(&path, SocketPermissions::default())
            };
            match bind() {
                Ok((socket, file)) => {
                    self.urls.push(ListenAddress::Unix(path).to_string());
                    self.files.push(file);
                    self.sockets.0.push(ListeningSocket::Unix(socket));
                }
                Err(error) => tracing::warn!("programs of this user need a token: {}: {error}", path.display()),
            }
            let path = folder.join(format!("{port}.memory.sock"));
            let added = create_private_folder(folder).and_then(|()| self.add_shared_memory(&path));
            if let Err(error) = added {
                tracing::warn!("programs of this user have no shared memory: {}: {error}", path.display());
            }
        }
    }

    fn add_shared_memory(&mut self, path: &Path) -> io::Result<()> {
        let (socket, file) = SocketFile::bind(path, SocketPermissions::default())?;
        self.shared_memory.push(socket);
        self.files.push(file);
        Ok(())
    }

    async fn add(&mut self, address: &ListenAddress, permissions: SocketPermissions) -> io::Result<()> {
        let (socket, file) = bind(address, permissions).await?;
        self.files.extend(file);
        match &socket {
            ListeningSocket::Tcp(listener) => {
                let bound_address = listener.local_addr()?;
                self.urls.push(format!("{}://{bound_address}", self.scheme()));
                self.addresses.push(bound_address);
            }
            ListeningSocket::Unix(_) => self.urls.push(address.to_string()),
        }
        self.sockets.0.push(socket);
        Ok(())
    }

    async fn add_admin(&mut self, address: &ListenAddress) -> io::Result<()> {
        let (socket, file) = bind(address, SocketPermissions::default()).await?;
        self.files.extend(file);
        self.admin_url = Some(match &socket {
            ListeningSocket::Tcp(listener) => format!("http://{}", listener.local_addr()?),
            ListeningSocket::Unix(_) => address.to_string(),
        });
        self.admin = Some(ListeningSockets(vec![socket]));
        Ok(())
    }

    const fn scheme(&self) -> &'static str {
        if self.tls.is_some() { "https" } else { "http" }
    }

    /// The URL of health and metrics: `http://IP:PORT` or `unix:PATH`. `None` if they are off.
    pub fn admin_url(&self) -> Option<&str> {
        self.admin_url.as_deref()
    }

    /// Whether the TCP sockets are encrypted.
    pub const fn is_encrypted(&self) -> bool {
        self.tls.is_some()
    }

    /// The file and the SHA-256 of a self-signed certificate. `None` without one.
    pub fn self_signed_certificate(&self) -> Option<(&Path, Arc<str>)> {
        self.tls.as_ref()?.self_signed_certificate()
    }

    /// The URLs for clients, in the order of the addresses: `http://IP:PORT`, `https://IP:PORT` or `unix:PATH`.
    pub fn urls(&self) -> &[String] {
        &self.urls
    }

    /// The addresses that other machines can connect to.
    pub fn remote_addresses(&self) -> impl Iterator<Item = SocketAddr> {
        self.addresses.iter().copied().filter(|address| !address.ip().is_loopback())
    }

    /// The URLs of the viewer: the public one, and those for browsers on this machine, in the order of the addresses. Empty
    /// if the viewer is off.
    pub fn viewer_urls(&self) -> Vec<String> {
        let public_url = self.public_url.iter().filter(|_| self.has_viewer).map(ToString::to_string);
        public_url.chain(self.viewer_addresses().map(|address| format!("{}://{address}", self.scheme()))).collect()
    }

    /// The URLs of the viewer for browsers on other machines, without the public one. Empty if the viewer is off, or the
    /// server encrypts nothing.
    pub fn remote_viewer_urls(&self) -> Vec<String> {
        let host = |address: SocketAddr| match address.ip().is_unspecified() {
            true => format!("{}:{}", host_name().unwrap_or_else(|| "HOST".into()), address.port()),
            false => address.to_string(),
        };
        let is_offered = self.has_viewer && self.is_encrypted();
        let addresses = self.remote_addresses().filter(|_| is_offered);
        addresses.map(|address| format!("https://{}", host(address))).collect()
    }

    /// A new link to the viewer at one of its URLs, for the user of the server. It is valid once.
    ///
    /// # Errors
    /// `Fault` when the system has no random numbers.
    pub fn viewer_link(&self, url: &str) -> Result<String> {
        Ok(url.to_owned() + &self.authenticator.viewer_url_path(self.authenticator.directory().owner())?)
    }

    /// The URL at which programs of this user reach the server: a Unix socket or, without one, a TCP socket.
    pub fn program_url(&self) -> Option<&str> {
        let unix = self.urls.iter().find(|url| url.starts_with("unix:"));
        unix.or_else(|| self.urls.first()).map(String::as_str)
    }

    /// The addresses in the viewer's URLs.
    pub fn viewer_addresses(&self) -> impl Iterator<Item = SocketAddr> {
        self.addresses.iter().filter(|_| self.has_viewer).map(|address| local_address(*address))
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

/// The names and addresses of this machine in the certificate of a server with these addresses. If it accepts clients of
/// other machines, also those by which they reach it.
fn own_names(listen: &[ListenAddress]) -> BTreeSet<String> {
    let mut names: BTreeSet<String> = ["localhost", "127.0.0.1", "::1"].map(str::to_owned).into();
    let tcp_ip = |address: &ListenAddress| match address {
        ListenAddress::Tcp(address) => Some(address.ip()).filter(|ip| !ip.is_unspecified()),
        ListenAddress::Unix(_) => None,
    };
    names.extend(listen.iter().filter_map(tcp_ip).map(|ip| ip.to_string()));
    if listen.iter().any(ListenAddress::is_remote) {
        names.extend(host_name());
        // The own addresses of routes to documentation addresses, to which nothing is sent (RFC 5737, RFC 3849).
        let routes = [("0.0.0.0:0", "192.0.2.1:9"), ("[::]:0", "[2001:db8::1]:9")];
        names.extend(routes.iter().filter_map(|(own, other)| {
            let socket = std::net::UdpSocket::bind(own).ok()?;
            socket.connect(other).ok()?;
            Some(socket.local_addr().ok()?.ip().to_string())
        }));
    }
    names
}

/// The name of this machine.
pub fn host_name() -> Option<String> {
    rustix::system::uname().nodename().to_str().ok().filter(|name| !name.is_empty()).map(str::to_owned)
}

/// Binds a socket. A Unix socket has a file.
async fn bind(
    address: &ListenAddress,
    permissions: SocketPermissions,
) -> io::Result<(ListeningSocket, Option<SocketFile>)> {
    match address {
        ListenAddress::Tcp(address) => Ok((ListeningSocket::Tcp(TcpListener::bind(address).await?), None)),
        ListenAddress::Unix(path) => {
            SocketFile::bind(path, permissions).map(|(socket, file)| (ListeningSocket::Unix(socket), Some(file)))
        }
    }
}

impl ListeningSockets {
    /// Accepts a connection on any of the sockets, and returns it with its client. Cancel-safe.
    pub(super) async fn accept(&self) -> io::Result<(Socket, Peer)> {
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
    fn poll_accept(&self, cx: &mut Context<'_>) -> Poll<io::Result<(Socket, Peer)>> {
        match self {
            Self::Tcp(listener) => listener.poll_accept(cx)?.map(|(stream, peer)| {
                stream.set_nodelay(true)?;
                Ok((Socket::Tcp(stream), Peer::new(peer.to_string(), None, None)))
            }),
            Self::Unix(listener) => listener.poll_accept(cx)?.map(|(stream, _)| {
                let credentials = stream.peer_cred().ok();
                let uid = credentials.map(|credentials| credentials.uid());
                let pid = credentials.and_then(|credentials| credentials.pid());
                let name = pid.map_or_else(|| "unix socket".to_owned(), |pid| format!("process {pid}"));
                Ok((Socket::Unix(stream), Peer::new(name, uid, pid)))
            }),
        }
    }
}

/// Creates a folder that only the user of this process can enter.
///
/// # Errors
/// An I/O error, also when the folder belongs to another user or others can enter it.
fn create_private_folder(folder: &Path) -> io::Result<()> {
    std::fs::DirBuilder::new().recursive(true).mode(0o700).create(folder)?;
    let metadata = std::fs::symlink_metadata(folder)?;
    let own_uid = rustix::process::geteuid().as_raw();
    if !metadata.is_dir() || metadata.uid() != own_uid || metadata.mode() & 0o077 != 0 {
        let given = format!("mode {:o} of user {}", metadata.mode() & 0o7777, metadata.uid());
        let text = format!("expected a folder of user {own_uid} with mode 700, got {given}");
        return Err(io::Error::new(io::ErrorKind::PermissionDenied, text));
    }
    Ok(())
}

/// The file of a Unix socket. Dropping it removes the file.
#[derive(Debug)]
pub(super) struct SocketFile {
    path: PathBuf,
    /// Device and inode, so that the file of another server at this path is not removed.
    identity: (u64, u64),
}

impl SocketFile {
    /// Binds a socket. Until it has its permissions, only the user of this process can connect.
    fn bind(path: &Path, permissions: SocketPermissions) -> io::Result<(UnixListener, Self)> {
        check_replaceable(path)?;
        // The socket gets its permissions before its name, and the rename replaces a stale file.
        let temporary_path = path.with_extension(format!("{}.new", std::process::id()));
        let bind = || {
            let listener = UnixListener::bind(&temporary_path)?;
            let set_mode = |mode| std::fs::set_permissions(&temporary_path, std::fs::Permissions::from_mode(mode));
            set_mode(0o600)?;
            if let Some(group) = permissions.group {
                std::os::unix::fs::chown(&temporary_path, None, Some(group))?;
            }
            set_mode(permissions.mode)?;
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
            Self::Tls(socket) => Pin::new(socket),
            Self::Unix(stream) => Pin::new(stream),
        }
    }

    /// The IP address at which the connection arrived. `None` for a Unix socket.
    pub(super) fn local_ip(&self) -> Option<IpAddr> {
        let stream = match self {
            Self::Tcp(stream) => stream,
            Self::Tls(socket) => socket.tcp(),
            Self::Unix(_) => return None,
        };
        stream.local_addr().ok().map(|address| address.ip().to_canonical())
    }

    /// The names of the client's certificate. Empty without one.
    pub(super) fn client_names(&self) -> Vec<CertificateName> {
        match self {
            Self::Tls(socket) => socket.client_names(),
            Self::Tcp(_) | Self::Unix(_) => Vec::new(),
        }
    }

    /// The names of the server's certificate. `None` without encryption.
    pub(super) fn certificate_names(&self) -> Option<Arc<[String]>> {
        match self {
            Self::Tls(socket) => Some(Arc::clone(&socket.host_names)),
            Self::Tcp(_) | Self::Unix(_) => None,
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
            Self::Tls(socket) => socket.is_write_vectored(),
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

    fn config(folder: &Path, socket: &Path) -> Config {
        let listen = vec![ListenAddress::Unix(socket.to_owned())];
        Config { listen, state: folder.join("state"), ..Config::default() }
    }

    #[tokio::test]
    async fn stale_socket_is_replaced_and_other_files_are_kept() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let path = folder.path().join("socket");
        let config = config(folder.path(), &path);
        // A standard library listener leaves its file, as a killed server does.
        drop(std::os::unix::net::UnixListener::bind(&path).expect("expected a socket"));
        let listener = Listener::bind(&config).await.expect("expected the stale socket to be replaced");
        assert_eq!(std::fs::metadata(&path).expect("expected a file").permissions().mode() & 0o777, 0o600);
        let error = Listener::bind(&config).await.expect_err("expected a socket in use").to_string();
        assert!(error.contains("another server"), "{error}");
        drop(listener);
        let names = std::fs::read_dir(folder.path()).expect("expected a folder");
        let names: Vec<_> = names.map(|entry| entry.expect("expected an entry").file_name()).collect();
        assert_eq!(names, ["state"]);
        std::fs::write(&path, "text").expect("expected a writable folder");
        assert!(Listener::bind(&config).await.is_err());
        assert_eq!(std::fs::read_to_string(&path).expect("expected the file"), "text");
    }

    #[tokio::test]
    async fn local_socket_has_the_name_of_the_port_in_a_private_folder() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let sockets = folder.path().join("a").join("modalcast");
        let listen = vec![ListenAddress::Tcp(([127, 0, 0, 1], 0).into())];
        let state = folder.path().join("state");
        let config = Config { listen, local_sockets: Some(sockets.clone()), state, ..Config::default() };
        let listener = Listener::bind(&config).await.expect("expected sockets");
        let port = listener.addresses[0].port();
        let [path, memory_path] = ["sock", "memory.sock"].map(|extension| sockets.join(format!("{port}.{extension}")));
        assert_eq!(listener.urls()[1], format!("unix:{}", path.display()));
        let mode = |path: &Path| std::fs::metadata(path).expect("expected a file").permissions().mode() & 0o777;
        assert_eq!((mode(&path), mode(&memory_path), mode(&sockets)), (0o600, 0o600, 0o700));
        assert_eq!(listener.shared_memory.len(), 1);
        drop(listener);
        assert!(!path.exists() && !memory_path.exists());
        // Others could replace sockets in this folder, so the server has none there.
        std::fs::set_permissions(&sockets, std::fs::Permissions::from_mode(0o777)).expect("expected new permissions");
        let listener = Listener::bind(&config).await.expect("expected a server without the socket");
        assert_eq!((listener.urls().len(), listener.shared_memory.len()), (1, 0));
    }

    /// Clients compare the name or address in their URL with the certificate.
    #[test]
    fn certificate_has_the_addresses_that_the_server_listens_on() {
        let names = |addresses: &[&str]| {
            let listen: Vec<ListenAddress> = addresses.iter().map(|text| text.parse().expect(text)).collect();
            own_names(&listen)
        };
        let local = names(&["127.0.0.1:1", "unix:/run/modalcast.sock"]);
        assert_eq!(local.iter().map(String::as_str).collect::<Vec<_>>(), ["127.0.0.1", "::1", "localhost"]);
        let remote = names(&["0.0.0.0:1", "192.0.2.7:1"]);
        assert!(remote.contains("192.0.2.7") && !remote.contains("0.0.0.0"), "{remote:?}");
        assert!(host_name().is_none_or(|name| remote.contains(&name)));
    }

    /// A server that was replaced does not remove the socket of its successor.
    #[tokio::test]
    async fn only_the_own_socket_file_is_removed() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let path = folder.path().join("socket");
        let config = config(folder.path(), &path);
        let first = Listener::bind(&config).await.expect("expected a socket");
        std::fs::remove_file(&path).expect("expected the file");
        let _second = Listener::bind(&config).await.expect("expected a socket");
        drop(first);
        assert!(path.exists());
    }
}
