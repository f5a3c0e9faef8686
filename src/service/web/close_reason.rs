//! Why the server closes a WebSocket.

use std::fmt::Display;
use std::io;

use tokio_tungstenite::tungstenite::error::Error as WebSocketError;
use tokio_tungstenite::tungstenite::protocol::CloseFrame;

use modalcast_model::error::Error;

/// Limit on the bytes of a reason (RFC 6455, 5.5: 125 with the code).
const MAX_REASON_BYTES: usize = 123;

/// A close code of `proto/websocket.md` and a text for people.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct CloseReason {
    code: u16,
    text: String,
}

impl CloseReason {
    fn new(code: u16, text: impl Into<String>) -> Self {
        let mut text: String = text.into();
        let end = text.char_indices().map(|(start, letter)| start + letter.len_utf8());
        text.truncate(end.take_while(|end| *end <= MAX_REASON_BYTES).last().unwrap_or(0));
        Self { code, text }
    }

    /// The client has closed the connection.
    pub(super) fn of_client() -> Self {
        Self::new(1000, "closed by the client")
    }

    pub(super) fn going_away() -> Self {
        Self::new(1001, "the server shuts down, or makes room for another client")
    }

    pub(super) fn text_message() -> Self {
        Self::new(1003, "expected a binary message, got text")
    }

    pub(super) fn policy(text: impl Into<String>) -> Self {
        Self::new(1008, text)
    }

    pub(super) fn internal() -> Self {
        Self::new(1011, "a call panicked in the server")
    }

    pub(super) fn malformed(expected: &str, given: impl Display) -> Self {
        Self::new(4000, format!("expected {expected}, got {given}"))
    }

    pub(super) fn invalid_id(expected: &str, given: impl Display) -> Self {
        Self::new(4001, format!("expected {expected}, got {given}"))
    }

    pub(super) fn unknown_session() -> Self {
        Self::new(4003, "expected the token of a session of this server")
    }

    pub(super) fn over_credit() -> Self {
        Self::new(4002, "expected credit for a message, got none")
    }

    /// The client holds its share of the bytes that are being received, or has lost them to another client.
    pub(super) fn receive_budget(error: &Error) -> Self {
        let code = if matches!(error, Error::Preempted { .. }) { 1013 } else { 1008 };
        Self::new(code, error.to_string())
    }

    /// The reason of a failed read. `None` if the connection is lost.
    pub(super) fn of_read_error(error: WebSocketError) -> Option<Self> {
        match error {
            WebSocketError::Io(error) => error.downcast::<Self>().ok(),
            WebSocketError::Capacity(error) => Some(Self::new(1009, error.to_string())),
            WebSocketError::Utf8(_) => Some(Self::text_message()),
            WebSocketError::Protocol(error) => Some(Self::new(1002, error.to_string())),
            _ => None,
        }
    }

    pub(super) fn into_frame(self) -> CloseFrame {
        CloseFrame { code: self.code.into(), reason: self.text.into() }
    }
}

impl Display for CloseReason {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(out, "{} ({})", self.text, self.code)
    }
}

impl std::error::Error for CloseReason {}

#[cfg(test)]
impl CloseReason {
    pub(super) const fn code(&self) -> u16 {
        self.code
    }
}

impl From<CloseReason> for io::Error {
    fn from(reason: CloseReason) -> Self {
        Self::other(reason)
    }
}
