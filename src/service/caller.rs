//! Who makes a call, and the log of the changes that callers make.

use std::sync::Arc;

use tonic::{Request, Status};

use super::connection::ConnectionInfo;
use super::reply_budget::CallReplies;
use super::status::{internal_fault, to_status};
use crate::admission::Account;
use crate::identity::{Credential, Principal};

/// What [`super::routes`] gives a call: it is in the extensions of the request.
#[derive(Clone)]
pub(super) struct AdmittedCall {
    /// `None` for a method that requires none.
    pub(super) credential: Option<Arc<Credential>>,
    /// What the permits of the call count to.
    pub(super) account: Account,
    pub(super) replies: Arc<CallReplies>,
}

/// Who makes a call.
#[derive(Debug, Clone)]
pub(super) struct Caller {
    pub(super) principal: Arc<Principal>,
    pub(super) credential: Arc<Credential>,
    pub(super) account: Account,
    /// Counts the replies of the call.
    pub(super) replies: Arc<CallReplies>,
    /// Address of the client, for the log.
    pub(super) peer: String,
}

impl Caller {
    /// # Errors
    /// `INTERNAL` for a request that was not admitted with a credential.
    pub(super) fn of<T>(request: &Request<T>) -> Result<Self, Status> {
        let call = request.extensions().get::<AdmittedCall>().cloned();
        let AdmittedCall { credential, account, replies } =
            call.ok_or_else(|| internal_fault("expected an admitted call"))?;
        let credential = credential.ok_or_else(|| internal_fault("expected a call with a credential"))?;
        let connection = ConnectionInfo::of(request).map_err(to_status)?;
        let principal = Arc::clone(credential.principal());
        let peer = connection.peer().to_owned();
        Ok(Self { principal, credential, account, replies, peer })
    }

    /// Logs the end of a client, or of several, and whether it has succeeded.
    pub(super) fn log_ended_client<T>(&self, client: &str, result: Result<T, Status>) -> Result<T, Status> {
        let (principal, peer, method) = (&self.principal.name, &self.peer, "EndClient");
        match &result {
            Ok(_) => tracing::info!(principal, peer, client, method, "ended"),
            Err(status) => {
                tracing::info!(principal, peer, client, method, code = ?status.code(), "not ended: {}", status.message());
            }
        }
        result
    }

    /// Logs a change of a scene, and whether it has succeeded.
    pub(super) fn log_change<T>(&self, method: &str, scene: &str, result: Result<T, Status>) -> Result<T, Status> {
        let (principal, peer) = (&self.principal.name, &self.peer);
        match &result {
            Ok(_) => tracing::info!(principal, peer, scene, method, "changed"),
            Err(status) => {
                tracing::info!(principal, peer, scene, method, code = ?status.code(), "not changed: {}", status.message());
            }
        }
        result
    }
}
