//! Principals and their credentials.

use std::sync::Arc;
use std::time::SystemTime;

use tokio::sync::watch;

use super::role::Role;

/// The name of the principal that has started the server.
pub const OWNER: &str = "owner";

/// Stands for the name of a principal in lists of clients none of whose calls was admitted with a credential.
pub const ANONYMOUS: &str = "anonymous";

/// Somebody who may use the server: a person, a program or a service.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Principal {
    pub name: String,
    pub role: Role,
}

impl Principal {
    /// The user of the server.
    pub fn owner() -> Self {
        Self { name: OWNER.into(), role: Role::Admin }
    }
}

/// What identifies a principal: the user of a Unix socket's client, a name of a client certificate, a bearer token, or an
/// administrator who makes a link to the viewer for it. It can be revoked, which ends the calls that it has admitted.
#[derive(Debug)]
pub struct Credential {
    principal: Arc<Principal>,
    expires: Option<SystemTime>,
    is_revoked: watch::Sender<bool>,
}

impl Credential {
    pub fn new(principal: Arc<Principal>, expires: Option<SystemTime>) -> Arc<Self> {
        Arc::new(Self { principal, expires, is_revoked: watch::Sender::new(false) })
    }

    pub fn principal(&self) -> &Arc<Principal> {
        &self.principal
    }

    /// Whether this and another credential admit the same calls.
    pub(super) fn is_equal(&self, other: &Self) -> bool {
        (&self.principal, self.expires) == (&other.principal, other.expires)
    }

    pub(super) fn has_expired(&self, now: SystemTime) -> bool {
        self.expires.is_some_and(|expires| expires <= now)
    }

    /// Ends the calls that the credential has admitted.
    pub fn revoke(&self) {
        self.is_revoked.send_replace(true);
    }

    pub fn is_revoked(&self) -> bool {
        *self.is_revoked.borrow()
    }

    /// Completes when the credential is revoked. Cancel-safe.
    pub async fn revoked(self: Arc<Self>) {
        let mut is_revoked = self.is_revoked.subscribe();
        // The sender exists as long as this credential.
        is_revoked.wait_for(|is_revoked| *is_revoked).await.ok();
    }
}
