//! The envelope of WebSocket messages, as `proto/websocket.md` specifies it.

use std::time::Duration;

use bytes::{Buf as _, Bytes};
use tonic::codegen::http::uri::PathAndQuery;

use super::close_reason::CloseReason;

/// Bytes of an envelope: the call id and the kind.
pub(super) const ENVELOPE_BYTES: usize = 5;

// Kinds of messages.
const START: u8 = 0;
const MESSAGE: u8 = 1;
const END: u8 = 2;
const CANCEL: u8 = 3;
const CREDIT: u8 = 4;
const STATUS: u8 = 5;
const SESSION: u8 = 6;

/// A message of the client.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct ClientMessage {
    pub(super) id: u32,
    pub(super) content: ClientContent,
}

#[derive(Debug, PartialEq, Eq)]
pub(super) enum ClientContent {
    Start(CallHead),
    /// An encoded protobuf message.
    Message(Bytes),
    /// The client sends no more messages of this call.
    End,
    Cancel,
    /// Bytes of messages that the client has processed.
    Credit(u32),
    /// The token of a viewer session.
    Session(String),
}

/// The content of a START message.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct CallHead {
    pub(super) timeout: Option<Duration>,
    pub(super) path: PathAndQuery,
}

impl ClientMessage {
    /// Parses a WebSocket message.
    ///
    /// # Errors
    /// The reason to close the connection.
    pub(super) fn parse(mut bytes: Bytes) -> Result<Self, CloseReason> {
        let given_bytes = bytes.len();
        let (Ok(id), Ok(kind)) = (bytes.try_get_u32_le(), bytes.try_get_u8()) else {
            return Err(CloseReason::malformed("at least 5 bytes", given_bytes));
        };
        let content = match kind {
            START => ClientContent::Start(CallHead::parse(bytes)?),
            MESSAGE => ClientContent::Message(bytes),
            END if bytes.is_empty() => ClientContent::End,
            CANCEL if bytes.is_empty() => ClientContent::Cancel,
            CREDIT if bytes.len() == 4 => ClientContent::Credit(bytes.get_u32_le()),
            SESSION if id == 0 => ClientContent::Session(parse_session(&bytes)?),
            SESSION => return Err(CloseReason::malformed("SESSION with the id 0", id)),
            END | CANCEL => return Err(CloseReason::malformed("END or CANCEL without payload", bytes.len())),
            CREDIT => return Err(CloseReason::malformed("CREDIT with 4 bytes", bytes.len())),
            _ => return Err(CloseReason::malformed("kind 0 to 4 or 6", kind)),
        };
        Ok(Self { id, content })
    }
}

fn parse_session(bytes: &[u8]) -> Result<String, CloseReason> {
    let text = std::str::from_utf8(bytes).map_err(|_| CloseReason::malformed("SESSION with a text", "other bytes"))?;
    Ok(text.to_owned())
}

impl CallHead {
    fn parse(mut bytes: Bytes) -> Result<Self, CloseReason> {
        let given_bytes = bytes.len();
        let Ok(timeout_ms) = bytes.try_get_u32_le() else {
            return Err(CloseReason::malformed("START with at least 4 bytes", given_bytes));
        };
        let timeout = (timeout_ms > 0).then(|| Duration::from_millis(timeout_ms.into()));
        let path = PathAndQuery::from_maybe_shared(bytes).ok().filter(|path| path.as_str().starts_with('/'));
        let path = path.ok_or_else(|| CloseReason::malformed("START with the path of a method", "another text"))?;
        Ok(Self { timeout, path })
    }
}

/// The kinds of messages that the server sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ServerKind {
    Message,
    Credit,
    Status,
}

/// The envelope of a message of the server.
pub(super) fn server_envelope(id: u32, kind: ServerKind) -> [u8; ENVELOPE_BYTES] {
    let kind = match kind {
        ServerKind::Message => MESSAGE,
        ServerKind::Credit => CREDIT,
        ServerKind::Status => STATUS,
    };
    let [a, b, c, d] = id.to_le_bytes();
    [a, b, c, d, kind]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(bytes: &[u8]) -> Result<ClientMessage, CloseReason> {
        ClientMessage::parse(Bytes::copy_from_slice(bytes))
    }

    #[test]
    fn every_kind_is_parsed() {
        let start = [&[1, 2, 0, 0, START][..], &1500_u32.to_le_bytes(), b"/a.b/C"].concat();
        let path = PathAndQuery::from_static("/a.b/C");
        let head = CallHead { timeout: Some(Duration::from_millis(1500)), path: path.clone() };
        assert_eq!(parse(&start), Ok(ClientMessage { id: 513, content: ClientContent::Start(head) }));
        let start = [&[0, 0, 0, 1, START][..], &[0; 4], b"/a.b/C"].concat();
        let content = ClientContent::Start(CallHead { timeout: None, path });
        assert_eq!(parse(&start), Ok(ClientMessage { id: 1 << 24, content }));
        for (payload, kind, content) in [
            (&b"xyz"[..], MESSAGE, ClientContent::Message(Bytes::from_static(b"xyz"))),
            (b"", MESSAGE, ClientContent::Message(Bytes::new())),
            (b"", END, ClientContent::End),
            (b"", CANCEL, ClientContent::Cancel),
            (&[0, 1, 0, 0], CREDIT, ClientContent::Credit(256)),
        ] {
            assert_eq!(parse(&[&[7, 0, 0, 0, kind], payload].concat()), Ok(ClientMessage { id: 7, content }));
        }
    }

    #[test]
    fn session_belongs_to_no_call() {
        let content = ClientContent::Session("ab".into());
        assert_eq!(parse(b"\0\0\0\0\x06ab"), Ok(ClientMessage { id: 0, content }));
        for bytes in [&b"\x01\0\0\0\x06ab"[..], b"\0\0\0\0\x06\xff"] {
            assert_eq!(parse(bytes).expect_err("expected a malformed message").code(), 4000);
        }
    }

    #[test]
    fn malformed_messages_have_a_close_code() {
        let invalid: [&[u8]; 11] = [
            b"",
            b"1234",
            b"\x01\0\0\0\x05",
            b"\x01\0\0\0\xff",
            b"\x01\0\0\0\x02x",
            b"\x01\0\0\0\x03x",
            b"\x01\0\0\0\x04\x01\0\0",
            b"\x01\0\0\0\x04\x01\0\0\0\0",
            b"\x01\0\0\0\0\0\0\0",
            b"\x01\0\0\0\0\0\0\0\0modalcast.v1.SceneService",
            b"\x01\0\0\0\0\0\0\0\0/a b\xff",
        ];
        for bytes in invalid {
            let reason = parse(bytes).expect_err("expected a malformed message");
            assert_eq!(reason.code(), 4000, "{bytes:?}");
        }
        assert!(parse(b"\x01\0\0\0\0\0\0\0\0/a").is_ok());
    }

    #[test]
    fn envelope_has_id_and_kind() {
        assert_eq!(server_envelope(0x0102_0304, ServerKind::Status), [4, 3, 2, 1, 5]);
        assert_eq!(server_envelope(1, ServerKind::Message)[4], 1);
        assert_eq!(server_envelope(1, ServerKind::Credit)[4], 4);
    }
}
