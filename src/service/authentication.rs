//! Finds the principal of each call and checks its role before the call reaches a service.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use prometheus_client::metrics::counter::Counter;
use tonic::Status;
use tonic::codegen::http::{HeaderMap, header};

use super::connection::ConnectionInfo;
use super::permissions::{Requirement, requirement_of};
use super::status::{to_status, unauthenticated, unknown_method};
use crate::config::{Authentication, Config};
use crate::engine::lock;
use crate::identity::{CertificateName, Credential, Directory};
use modalcast_model::error::{Error, Result};

/// Shortest time between two log records of rejected calls.
const LOG_INTERVAL: Duration = Duration::from_secs(1);

/// Admits calls.
#[derive(Debug)]
pub(super) struct Authenticator {
    directory: Arc<Directory>,
    authentication: Authentication,
    wrong_token_delay: Duration,
    rejections: Mutex<Rejections>,
    /// All rejected calls.
    failures: Counter,
}

/// Rejected calls since the last log record.
#[derive(Debug, Default)]
struct Rejections {
    count: u64,
    last_record: Option<Instant>,
}

/// Why a call is not admitted.
#[derive(Debug)]
pub(super) struct Denial {
    pub(super) status: Status,
    /// Time before the answer.
    pub(super) delay: Duration,
}

impl Authenticator {
    /// # Errors
    /// As for [`Directory::open`].
    pub(super) fn new(config: &Config) -> Result<Arc<Self>> {
        let directory = Directory::open(&config.token_file(), config.principals.as_deref())?;
        let (rejections, failures) = (Mutex::default(), Counter::default());
        Ok(Arc::new(Self {
            directory: Arc::new(directory),
            authentication: config.authentication,
            wrong_token_delay: config.wrong_token_delay,
            rejections,
            failures,
        }))
    }

    pub(super) fn directory(&self) -> &Arc<Directory> {
        &self.directory
    }

    /// Waits before the answer to a wrong token.
    pub(super) async fn delay_wrong_token(&self) {
        tokio::time::sleep(self.wrong_token_delay).await;
    }

    /// The number of rejected calls.
    pub(super) const fn failures(&self) -> &Counter {
        &self.failures
    }

    /// The credential of a connection itself, which calls without a token use. `uid` is the user of a Unix socket's client,
    /// and `certificate_names` are those of a client certificate.
    pub(super) fn credential_of_connection(
        &self,
        uid: Option<u32>,
        certificate_names: &[CertificateName],
    ) -> Option<Arc<Credential>> {
        let of_certificate = || self.directory.find_certificate(certificate_names);
        match self.authentication {
            Authentication::Off => Some(Arc::clone(self.directory.owner())),
            Authentication::UsersAndTokens => of_certificate().or_else(|| self.directory.find_uid(uid?)),
            Authentication::Tokens => of_certificate(),
        }
    }

    /// The path of a new link to the viewer, whose session has the rights of a credential. A server without authentication
    /// needs no code.
    ///
    /// # Errors
    /// `Fault` when the system has no random numbers.
    pub(super) fn viewer_url_path(&self, credential: &Arc<Credential>) -> Result<String> {
        match self.authentication {
            Authentication::Off => Ok("/".into()),
            _ => Ok(format!("/#code={}", self.directory.viewer_sessions().new_code(credential)?)),
        }
    }

    pub(super) fn authentication(&self) -> Authentication {
        self.authentication
    }

    /// Admits a call. Its bearer token outranks the credential of its connection. Returns the credential of the caller, or
    /// `None` for a method that requires none.
    ///
    /// # Errors
    /// A denial with the status `UNAUTHENTICATED` for a wrong token or no credential, `PERMISSION_DENIED` for a method
    /// that the role does not permit, and `UNIMPLEMENTED` for one that is not listed.
    pub(super) fn admit(
        &self,
        path: &str,
        headers: &HeaderMap,
        connection: &ConnectionInfo,
    ) -> Result<Option<Arc<Credential>>, Denial> {
        let peer = connection.peer();
        let unlisted = || Denial { status: unknown_method(), delay: Duration::ZERO };
        let requirement = requirement_of(path).ok_or_else(unlisted)?;
        let Requirement::Role(role) = requirement else { return Ok(None) };
        let of_call = self.credential_of_call(headers, connection);
        let wrong_token = |()| Denial {
            delay: self.wrong_token_delay,
            ..self.deny(unauthenticated("a token that this server knows", "another token"), peer)
        };
        let Some(credential) = of_call.map_err(wrong_token)?.filter(|credential| !credential.is_revoked()) else {
            let expected =
                "a token, a client certificate, or the server's Unix socket, of a user whom the server knows";
            return Err(self.deny(unauthenticated(expected, "none of them"), peer));
        };
        let principal = credential.principal();
        if principal.role < role {
            let expected = format!("the role '{}'", role.name());
            let given = format!("'{}' with the role '{}'", principal.name, principal.role.name());
            return Err(self.deny(to_status(Error::NotPermitted { expected, given }), peer));
        }
        Ok(Some(credential))
    }

    /// The credential of a call, if it has one. `Err` for a wrong token.
    fn credential_of_call(
        &self,
        headers: &HeaderMap,
        connection: &ConnectionInfo,
    ) -> Result<Option<Arc<Credential>>, ()> {
        let of_connection = connection.credential.clone();
        // A server without authentication knows no tokens.
        if self.authentication == Authentication::Off || !headers.contains_key(header::AUTHORIZATION) {
            return Ok(of_connection);
        }
        bearer_token(headers).and_then(|token| self.directory.find_token(token)).map(Some).ok_or(())
    }

    /// Denies a call, and logs the denials of each [`LOG_INTERVAL`] in one record.
    fn deny(&self, status: Status, peer: &str) -> Denial {
        self.failures.inc();
        let mut rejections = lock(&self.rejections);
        rejections.count += 1;
        if rejections.last_record.is_none_or(|last_record| last_record.elapsed() >= LOG_INTERVAL) {
            tracing::warn!(peer, calls = rejections.count, "rejected: {}", status.message());
            *rejections = Rejections { count: 0, last_record: Some(Instant::now()) };
        }
        Denial { status, delay: Duration::ZERO }
    }
}

/// The bearer token of a call (RFC 6750, 2.1). `None` for another header, and for more than one.
pub(super) fn bearer_token(headers: &HeaderMap) -> Option<&str> {
    let mut values = headers.get_all(header::AUTHORIZATION).iter();
    let (scheme, token) = values.next()?.to_str().ok()?.split_once(' ')?;
    (scheme.eq_ignore_ascii_case("bearer") && values.next().is_none()).then_some(token.trim())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bearer_token_is_the_only_value_of_its_header() {
        let token = |values: &[&str]| {
            let mut headers = HeaderMap::new();
            for value in values {
                headers.append(header::AUTHORIZATION, value.parse().expect("expected a header value"));
            }
            bearer_token(&headers).map(str::to_owned)
        };
        assert_eq!(token(&["Bearer abc"]).as_deref(), Some("abc"));
        assert_eq!(token(&["bearer  abc "]).as_deref(), Some("abc"));
        for values in [&[][..], &["abc"], &["Basic abc"], &["Bearer"], &["Bearer abc", "Bearer abc"]] {
            assert_eq!(token(values), None, "{values:?}");
        }
    }
}
