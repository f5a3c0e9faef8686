//! Answers clients that do not speak TLS, so that they learn why they are rejected.

use std::io;

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

/// First byte of a TLS connection: the type of a handshake record (RFC 8446, 5.1).
const HANDSHAKE_RECORD: u8 = 22;

/// What a client with a plain connection should do.
const ADVICE: &str = "expected TLS: use https:// in the URL of this server";

/// Whether the first byte of a connection, which remains unread, does not begin TLS. False at the end of the connection.
/// Cancel-safe.
pub(super) async fn is_plain(stream: &TcpStream) -> io::Result<bool> {
    let mut first = [0];
    let bytes = stream.peek(&mut first).await?;
    Ok(bytes == 1 && first[0] != HANDSHAKE_RECORD)
}

/// Answers in HTTP/1.1, which clients of gRPC report, too, and reads until the client closes the connection: unread bytes
/// would reset it before the client has read the answer.
pub(super) async fn answer(mut stream: TcpStream) -> io::Result<()> {
    let length = ADVICE.len() + 1;
    let answer = format!(
        "HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain; charset=utf-8\r\nContent-Length: {length}\r\n\
         Connection: close\r\n\r\n{ADVICE}\n"
    );
    stream.write_all(answer.as_bytes()).await?;
    stream.shutdown().await?;
    let mut request = [0; 1024];
    while stream.read(&mut request).await? > 0 {}
    Ok(())
}
