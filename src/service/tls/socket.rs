//! A TLS connection.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio_rustls::server::TlsStream;

use super::certificate::client_names;
use crate::identity::CertificateName;

/// The server's end of a TLS connection after its handshake.
#[derive(Debug)]
pub(in crate::service) struct TlsSocket {
    stream: Box<TlsStream<TcpStream>>,
    /// The names of the server's certificate.
    pub(in crate::service) host_names: Arc<[String]>,
}

impl TlsSocket {
    pub(super) fn new(stream: TlsStream<TcpStream>, host_names: Arc<[String]>) -> Self {
        Self { stream: Box::new(stream), host_names }
    }

    /// The TCP connection below.
    pub(in crate::service) fn tcp(&self) -> &TcpStream {
        self.stream.get_ref().0
    }

    /// The names of the client's certificate, which was verified. Empty without a certificate.
    pub(in crate::service) fn client_names(&self) -> Vec<CertificateName> {
        let certificates = self.stream.get_ref().1.peer_certificates();
        certificates.and_then(<[_]>::first).map_or_else(Vec::new, |certificate| client_names(certificate))
    }
}

impl AsyncRead for TlsSocket {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, buffer)
    }
}

impl AsyncWrite for TlsSocket {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(cx, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}
