//! Sessions of browsers. A link to the viewer has a code that is valid once; the page exchanges it for the token of a
//! session, so that a link in a terminal, a log or the history of a browser admits nobody afterwards.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::principal::Credential;
use super::token::{TokenHash, new_token};
use modalcast_model::error::Result;

/// Time within which a code must be used.
const CODE_LIFETIME: Duration = Duration::from_secs(24 * 3600);

/// Limit on the codes that are not used yet. A further one replaces the oldest.
const MAX_CODES: usize = 256;

/// Limit on the sessions. A further one replaces the one that was used longest ago.
const MAX_SESSIONS: usize = 1024;

/// Codes and sessions of a server. They end with the server.
#[derive(Debug, Default)]
pub struct ViewerSessions {
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    /// Oldest first.
    codes: VecDeque<Entry>,
    /// The one that was used longest ago first.
    sessions: VecDeque<Entry>,
}

/// A code or a session, and the credential whose calls it admits.
#[derive(Debug)]
struct Entry {
    hash: TokenHash,
    created: Instant,
    credential: Arc<Credential>,
}

impl Entry {
    fn new(token: &str, credential: Arc<Credential>) -> Option<Self> {
        Some(Self { hash: TokenHash::of(token)?, created: Instant::now(), credential })
    }
}

impl ViewerSessions {
    /// A new code, for a session with the rights of a credential.
    ///
    /// # Errors
    /// `Fault` when the system has no random numbers.
    pub fn new_code(&self, credential: &Arc<Credential>) -> Result<String> {
        let code = new_token()?;
        push_bounded(&mut self.lock().codes, Entry::new(&code, Arc::clone(credential)), MAX_CODES);
        Ok(code)
    }

    /// Exchanges a code for the token of a new session. `None` for a code that is unknown, used, too old, or of a
    /// credential that was revoked.
    ///
    /// # Errors
    /// `Fault` when the system has no random numbers.
    pub fn redeem(&self, code: &str) -> Result<Option<String>> {
        let Some(hash) = TokenHash::of(code) else { return Ok(None) };
        let session = new_token()?;
        let mut state = self.lock();
        let entry = take(&mut state.codes, hash).filter(|entry| entry.created.elapsed() < CODE_LIFETIME);
        let Some(entry) = entry.filter(|entry| !entry.credential.is_revoked()) else { return Ok(None) };
        push_bounded(&mut state.sessions, Entry::new(&session, entry.credential), MAX_SESSIONS);
        Ok(Some(session))
    }

    /// The credential of a session. `None` for an unknown session, and for one whose credential was revoked.
    pub fn find(&self, session: &str) -> Option<Arc<Credential>> {
        let mut state = self.lock();
        let entry =
            take(&mut state.sessions, TokenHash::of(session)?).filter(|entry| !entry.credential.is_revoked())?;
        let credential = Arc::clone(&entry.credential);
        state.sessions.push_back(entry);
        Some(credential)
    }

    /// Ends a session. Has no effect on calls that it has admitted.
    pub fn end(&self, session: &TokenHash) {
        take(&mut self.lock().sessions, *session);
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Appends an entry. Removes the first one if there are too many.
fn push_bounded(entries: &mut VecDeque<Entry>, entry: Option<Entry>, limit: usize) {
    if entries.len() >= limit {
        entries.pop_front();
    }
    entries.extend(entry);
}

fn take(entries: &mut VecDeque<Entry>, hash: TokenHash) -> Option<Entry> {
    let index = entries.iter().position(|entry| entry.hash == hash)?;
    entries.remove(index)
}

#[cfg(test)]
mod tests {
    use super::super::principal::Principal;
    use super::*;

    fn credential() -> Arc<Credential> {
        Credential::new(Arc::new(Principal::owner()), None)
    }

    fn redeem(sessions: &ViewerSessions, code: &str) -> Option<String> {
        sessions.redeem(code).expect("expected random numbers")
    }

    #[test]
    fn code_is_valid_once_and_gives_its_credential() {
        let (sessions, credential) = (ViewerSessions::default(), credential());
        let code = sessions.new_code(&credential).expect("expected random numbers");
        let session = redeem(&sessions, &code).expect("expected a session");
        assert!(Arc::ptr_eq(&sessions.find(&session).expect("expected a credential"), &credential));
        assert!(sessions.find(&session).is_some(), "expected that a session is valid many times");
        for text in ["", &code, &session, &code[1..], "x"] {
            assert_eq!(redeem(&sessions, text), None, "{text}");
        }
        for text in ["", &code, &session[1..], "x"] {
            assert!(sessions.find(text).is_none(), "{text}");
        }
    }

    #[test]
    fn revoked_credential_ends_its_codes_and_sessions() {
        let (sessions, credential) = (ViewerSessions::default(), credential());
        let [first, second] = [(); 2].map(|()| sessions.new_code(&credential).expect("expected random numbers"));
        let session = redeem(&sessions, &first).expect("expected a session");
        credential.revoke();
        assert_eq!(redeem(&sessions, &second), None);
        assert!(sessions.find(&session).is_none());
    }

    #[test]
    fn ended_session_is_unknown() {
        let sessions = ViewerSessions::default();
        let [ended, other] = [(); 2].map(|()| {
            let code = sessions.new_code(&credential()).expect("expected random numbers");
            redeem(&sessions, &code).expect("expected a session")
        });
        sessions.end(&TokenHash::of(&ended).expect("expected a token"));
        assert!(sessions.find(&ended).is_none() && sessions.find(&other).is_some());
    }

    #[test]
    fn oldest_codes_and_unused_sessions_are_replaced() {
        let (sessions, credential) = (ViewerSessions::default(), credential());
        let new_code = || sessions.new_code(&credential).expect("expected random numbers");
        let first = new_code();
        let codes: Vec<_> = (0..MAX_CODES).map(|_| new_code()).collect();
        assert_eq!(redeem(&sessions, &first), None);
        let in_use = redeem(&sessions, &codes[0]).expect("expected a session");
        let unused = redeem(&sessions, &codes[1]).expect("expected a session");
        for _ in 2..MAX_SESSIONS {
            redeem(&sessions, &new_code()).expect("expected a session");
        }
        assert!(sessions.find(&in_use).is_some());
        redeem(&sessions, &new_code()).expect("expected a session");
        assert!(sessions.find(&in_use).is_some() && sessions.find(&unused).is_none());
    }
}
