//! The holders of permits.

use std::sync::Arc;

use crate::identity::{Principal, TokenHash};

/// A holder of permits: a client of a principal.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Account {
    /// The name of the principal. `None` while the client is anonymous: none of its calls was admitted with a credential.
    pub principal: Option<Arc<str>>,
    pub client: Client,
}

/// What distinguishes the clients of a principal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Client {
    /// The server itself, and programs that run the engine in their process.
    Server,
    /// All clients of the principal, for what outlives them.
    Any,
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
}
