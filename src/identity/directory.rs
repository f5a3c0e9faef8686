//! Finds the principal of a credential.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;

use super::certificate_name::CertificateName;
use super::file_version::{FileVersion, REFRESH_INTERVAL};
use super::principal::{Credential, OWNER, Principal};
use super::principals_file::Credentials;
use super::token::{TokenHash, read_or_create_token};
use super::viewer_sessions::ViewerSessions;
use modalcast_model::error::Result;

/// The credentials of a server. Its own user and its own token identify the owner; a file names further principals.
#[derive(Debug)]
pub struct Directory {
    owner: Arc<Credential>,
    own_uid: u32,
    own_token: TokenHash,
    file: Option<PathBuf>,
    state: Mutex<DirectoryState>,
    viewer_sessions: ViewerSessions,
}

#[derive(Debug)]
struct DirectoryState {
    credentials: Credentials,
    /// Version of the file of `credentials`, or of a later one that is invalid.
    version: Option<FileVersion>,
}

impl Directory {
    /// Reads the server's own token, or creates it, and the file of principals.
    ///
    /// # Errors
    /// `Unavailable` for the file of the token; `InvalidFile` for that of the principals.
    pub fn open(token_file: &Path, principals: Option<&Path>) -> Result<Self> {
        let own_uid = rustix::process::geteuid().as_raw();
        let version = principals.and_then(FileVersion::of);
        let credentials =
            principals.map_or_else(|| Ok(Credentials::default()), |path| Credentials::read(path, own_uid))?;
        Ok(Self {
            owner: Credential::new(Arc::new(Principal::owner()), None),
            own_uid,
            own_token: read_or_create_token(token_file)?,
            file: principals.map(Path::to_owned),
            state: Mutex::new(DirectoryState { credentials, version }),
            viewer_sessions: ViewerSessions::default(),
        })
    }

    pub fn owner(&self) -> &Arc<Credential> {
        &self.owner
    }

    /// The credential of a user of this machine.
    pub fn find_uid(&self, uid: u32) -> Option<Arc<Credential>> {
        if uid == self.own_uid {
            return Some(Arc::clone(&self.owner));
        }
        self.lock().credentials.by_uid.get(&uid).cloned()
    }

    /// The credential of a client certificate with these names. The first name that a principal has decides.
    pub fn find_certificate(&self, names: &[CertificateName]) -> Option<Arc<Credential>> {
        let state = self.lock();
        names.iter().find_map(|name| state.credentials.by_certificate.get(name)).cloned()
    }

    /// The credential of a bearer token.
    pub fn find_token(&self, token: &str) -> Option<Arc<Credential>> {
        let hash = TokenHash::of(token)?;
        if hash == self.own_token {
            return Some(Arc::clone(&self.owner));
        }
        let credential = self.lock().credentials.by_token.get(&hash).cloned()?;
        (!credential.has_expired(SystemTime::now())).then_some(credential)
    }

    /// The credential for viewer sessions of the principal with this name.
    pub fn find_name(&self, name: &str) -> Option<Arc<Credential>> {
        if name == OWNER {
            return Some(Arc::clone(&self.owner));
        }
        self.lock().credentials.by_name.get(name).cloned()
    }

    pub const fn viewer_sessions(&self) -> &ViewerSessions {
        &self.viewer_sessions
    }

    /// Keeps the credentials up to date until this future is dropped.
    pub async fn keep_fresh(&self) {
        let mut interval = tokio::time::interval(REFRESH_INTERVAL);
        loop {
            interval.tick().await;
            self.refresh(SystemTime::now());
        }
    }

    /// Revokes tokens that have expired, and reads the file of principals again if it has changed. Credentials that the
    /// new file does not have are revoked. An invalid file is logged and changes nothing.
    fn refresh(&self, now: SystemTime) {
        let mut state = self.lock();
        state.credentials.all().filter(|credential| credential.has_expired(now)).for_each(|expired| expired.revoke());
        let Some(path) = &self.file else { return };
        let version = FileVersion::of(path);
        if version == state.version {
            return;
        }
        state.version = version;
        match Credentials::read(path, self.own_uid) {
            Ok(mut credentials) => {
                credentials.take_over(&state.credentials);
                tracing::info!(credentials = credentials.all().count(), "the file of principals was read again");
                state.credentials = credentials;
            }
            Err(error) => tracing::error!(%error, "the changed file of principals is not used"),
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, DirectoryState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    struct Files {
        folder: tempfile::TempDir,
    }

    impl Files {
        fn new(principals: &str) -> Self {
            let files = Self { folder: tempfile::tempdir().expect("expected a temporary folder") };
            files.write(principals);
            files
        }

        fn principals(&self) -> PathBuf {
            self.folder.path().join("principals.toml")
        }

        /// Replaces the file, as editors do.
        fn write(&self, principals: &str) {
            let new = self.folder.path().join("new");
            fs::write(&new, principals).expect("expected a writable folder");
            fs::rename(&new, self.principals()).expect("expected a writable folder");
        }

        fn open(&self) -> Directory {
            let token_file = self.folder.path().join("token");
            Directory::open(&token_file, Some(&self.principals())).expect("expected a directory")
        }

        fn own_token(&self) -> String {
            fs::read_to_string(self.folder.path().join("token")).expect("expected a file").trim().into()
        }
    }

    fn entry(name: &str, role: &str, token: &str, expires: &str) -> String {
        let hash = TokenHash::of(token).expect("expected a token");
        format!("[[principal]]\nname = '{name}'\nrole = '{role}'\n[[principal.token]]\nsha256 = '{hash}'\n{expires}\n")
    }

    fn name_of(credential: Option<Arc<Credential>>) -> Option<String> {
        credential.map(|credential| credential.principal().name.clone())
    }

    #[test]
    fn own_user_and_own_token_identify_the_owner() {
        let files = Files::new(&entry("anna", "view", "secret", ""));
        let directory = files.open();
        let own_uid = rustix::process::geteuid().as_raw();
        assert_eq!(name_of(directory.find_uid(own_uid)).as_deref(), Some("owner"));
        assert_eq!(name_of(directory.find_token(&files.own_token())).as_deref(), Some("owner"));
        assert_eq!(name_of(directory.find_token("secret")).as_deref(), Some("anna"));
        for uid in [own_uid.wrapping_add(1), 65534, u32::MAX] {
            assert_eq!(name_of(directory.find_uid(uid)), None, "{uid}");
        }
        for token in ["", "secre", "Secret", "secret ", "owner", &files.own_token()[1..]] {
            assert_eq!(name_of(directory.find_token(token)), None, "{token}");
        }
    }

    /// Calls of credentials that stay continue, and those of others end.
    #[tokio::test]
    async fn changed_file_revokes_the_credentials_that_it_lacks() {
        let both = entry("anna", "view", "a", "") + &entry("ben", "view", "b", "");
        let files = Files::new(&both);
        let directory = files.open();
        let [anna, ben] = ["a", "b"].map(|token| directory.find_token(token).expect("expected a principal"));
        directory.refresh(SystemTime::now());
        assert!(!anna.is_revoked() && !ben.is_revoked(), "expected no effect of an unchanged file");
        // An invalid file changes nothing.
        files.write("[[principal]]");
        directory.refresh(SystemTime::now());
        assert!(directory.find_token("b").is_some() && !ben.is_revoked());
        let ben_revoked = tokio::spawn(Arc::clone(&ben).revoked());
        files.write(&(entry("anna", "view", "a", "") + &entry("ben", "drive", "b", "")));
        directory.refresh(SystemTime::now());
        tokio::time::timeout(crate::hang_guard::HANG_GUARD, ben_revoked)
            .await
            .expect("expected an end")
            .expect("no panic");
        assert!(!anna.is_revoked(), "expected the equal credential to stay");
        let ben = directory.find_token("b").expect("expected a principal");
        assert_eq!((ben.principal().role, ben.is_revoked()), (super::super::Role::Drive, false));
        files.write("");
        directory.refresh(SystemTime::now());
        assert!(anna.is_revoked() && ben.is_revoked() && directory.find_token("a").is_none());
    }

    #[test]
    fn first_known_name_of_a_certificate_identifies_a_principal() {
        let files = Files::new(
            "[[principal]]\nname = 'anna'\nrole = 'drive'\ncertificates = ['Anna.lab.example', 'anna@lab.example']\n\
             [[principal]]\nname = 'ben'\nrole = 'view'\ncertificates = ['spiffe://lab.example/ben']\n",
        );
        let directory = files.open();
        let find = |names: &[&str]| {
            let names: Vec<_> = names.iter().map(|name| CertificateName::new(name)).collect();
            directory.find_certificate(&names)
        };
        assert_eq!(name_of(find(&["anna.lab.example"])).as_deref(), Some("anna"));
        assert_eq!(
            name_of(find(&["host.lab.example", "spiffe://lab.example/ben", "anna@lab.example"])),
            Some("ben".into())
        );
        for names in [&[][..], &["lab.example"], &["spiffe://lab.example/BEN"], &["anna"], &["owner"]] {
            assert_eq!(name_of(find(names)), None, "{names:?}");
        }
        let anna = find(&["anna@lab.example"]).expect("expected a principal");
        files.write("[[principal]]\nname = 'anna'\nrole = 'drive'\ncertificates = ['anna.lab.example']\n");
        directory.refresh(SystemTime::now());
        assert!(anna.is_revoked() && find(&["anna@lab.example"]).is_none());
        assert!(find(&["anna.lab.example"]).is_some_and(|credential| !credential.is_revoked()));
    }

    #[test]
    fn expired_token_identifies_nobody() {
        let files = Files::new(
            &(entry("anna", "view", "a", "expires = '2020-01-01T00:00:00Z'")
                + &entry("ben", "view", "b", "expires = '2999-01-01T00:00:00Z'")),
        );
        let directory = files.open();
        assert_eq!(name_of(directory.find_token("a")), None);
        let ben = directory.find_token("b").expect("expected a principal");
        directory.refresh(SystemTime::now());
        assert!(!ben.is_revoked());
        directory.refresh(humantime::parse_rfc3339("2999-01-01T00:00:00Z").expect("expected a time"));
        assert!(ben.is_revoked());
    }
}
