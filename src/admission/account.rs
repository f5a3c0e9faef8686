//! The holders of permits.

use std::fmt;
use std::sync::Arc;

use crate::identity::{ANONYMOUS, Principal, TokenHash};

/// A holder of permits: a client of a principal. Its text is an id for people: `anna/process-4711`,
/// `owner/session-ba7816bf` or `anonymous/connection-12`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Account {
    /// The name of the principal. `None` while the client is anonymous: none of its calls was admitted with a credential.
    pub principal: Option<Arc<str>>,
    pub client: Client,
}

/// What distinguishes the clients of a principal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Client {
    /// The server itself, which keeps what outlives clients, and programs that run the engine in their process.
    Server,
    /// A session of the viewer, by its token.
    Session(TokenHash),
    /// A process that is connected to a Unix socket, by its id.
    Process(i32),
    /// A connection, by its number, which no other connection of the server has.
    Connection(u64),
}

impl Account {
    pub fn new(principal: &Principal, client: Client) -> Self {
        Self { principal: Some(principal.name.as_str().into()), client }
    }

    /// The account of the server itself.
    pub fn server() -> Self {
        Self::new(&Principal::owner(), Client::Server)
    }

    pub const fn anonymous(client: Client) -> Self {
        Self { principal: None, client }
    }

    /// The name of the principal, or [`ANONYMOUS`].
    pub fn principal_name(&self) -> &str {
        self.principal.as_deref().unwrap_or(ANONYMOUS)
    }
}

impl fmt::Display for Account {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}/", self.principal_name())?;
        match self.client {
            Client::Server => out.write_str("server"),
            Client::Session(token) => write!(out, "session-{}", token.short_name()),
            Client::Process(id) => write!(out, "process-{id}"),
            Client::Connection(number) => write!(out, "connection-{number}"),
        }
    }
}
