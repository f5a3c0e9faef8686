//! An entry of the scene catalog: where a scene comes from, and who may use it.

use std::collections::BTreeSet;
use std::sync::Arc;

use tokio::sync::watch;

use super::provenance::SceneProvenance;
use crate::identity::{OWNER, Principal, Role, check_principal_name};
use modalcast_model::error::{Error, Result, invalid};

/// Stands for all principals in [`SceneAccess::shared_with`].
pub const EVERYONE: &str = "*";

/// Limit on the principals with whom a scene is shared: as many as a file of principals has.
const MAX_SHARES: usize = 256;

/// What the catalog stores of a scene. Records of versions without principals have no owner; they belong to the user of
/// the server.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub(in crate::engine) struct SceneRecord {
    #[serde(flatten)]
    pub(in crate::engine) provenance: SceneProvenance,
    #[serde(flatten)]
    pub(in crate::engine) access: SceneAccess,
}

/// Who may use a scene: the principal that it belongs to, and the principals with whom it is shared.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct SceneAccess {
    /// Name of the principal that has opened the scene.
    #[serde(default = "server_user", skip_serializing_if = "is_server_user")]
    pub owner: String,
    /// Names of principals, or [`EVERYONE`].
    #[serde(default, skip_serializing_if = "BTreeSet::is_empty")]
    pub shared_with: BTreeSet<String>,
}

/// Who may use a scene. The registry and the handle of the scene share it.
pub(in crate::engine) type SharedAccess = Arc<watch::Sender<SceneAccess>>;

/// What a principal may do with a scene, within its role.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum SceneRight {
    /// Use the scene without taking it from others: receive its steps, apply forces, drive it while it has no writer.
    Use,
    /// Also delete, reset and share it, replace its writer, and slow its writer by lossless streams.
    Control,
}

impl SceneRecord {
    pub(in crate::engine) const fn is_upload(&self) -> bool {
        matches!(self.provenance, SceneProvenance::Upload { .. })
    }
}

fn server_user() -> String {
    OWNER.into()
}

fn is_server_user(name: &str) -> bool {
    name == OWNER
}

impl SceneAccess {
    /// A scene that belongs to a principal and is not shared.
    pub fn new(principal: &Principal) -> Self {
        Self { owner: principal.name.clone(), shared_with: BTreeSet::new() }
    }

    /// Replaces the principals with whom the scene is shared.
    ///
    /// # Errors
    /// `Invalid` for more than 256 names, and for a malformed name.
    pub fn share_with(self, names: Vec<String>) -> Result<Self> {
        if names.len() > MAX_SHARES {
            return Err(invalid("principals", format!("at most {MAX_SHARES} names"), names.len()));
        }
        for (index, name) in names.iter().enumerate() {
            if name != EVERYONE {
                check_principal_name(name).map_err(|error| error.prefix_field(&format!("principals[{index}]")))?;
            }
        }
        Ok(Self { shared_with: names.into_iter().collect(), ..self })
    }

    /// The largest right of a principal. `None` for a scene that the principal may not know of.
    pub fn right_of(&self, principal: &Principal) -> Option<SceneRight> {
        if principal.role == Role::Admin || principal.name == self.owner {
            return Some(SceneRight::Control);
        }
        let is_shared = self.shared_with.contains(EVERYONE) || self.shared_with.contains(&principal.name);
        is_shared.then_some(SceneRight::Use)
    }

    /// Checks that a principal has a right to the scene `name`.
    ///
    /// # Errors
    /// `NotFound` if the principal may not know of the scene, as for a scene that does not exist; `NotPermitted` if it may
    /// only use the scene.
    pub(in crate::engine) fn check(&self, name: &str, principal: &Principal, right: SceneRight) -> Result<()> {
        match self.right_of(principal) {
            None => Err(crate::engine::scene_not_open(name)),
            Some(given) if given >= right => Ok(()),
            Some(_) => Err(Error::NotPermitted {
                expected: format!("the owner of the scene '{name}'"),
                given: format!("'{}', with whom it is shared", principal.name),
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn principal(name: &str, role: Role) -> Principal {
        Principal { name: name.into(), role }
    }

    #[test]
    fn rights_follow_ownership_sharing_and_the_role_admin() {
        let anna = principal("anna", Role::Upload);
        let ben = principal("ben", Role::Upload);
        let private = SceneAccess::new(&anna);
        assert_eq!(private.right_of(&anna), Some(SceneRight::Control));
        assert_eq!(private.right_of(&ben), None);
        assert_eq!(private.right_of(&principal("root", Role::Admin)), Some(SceneRight::Control));
        let shared = private.clone().share_with(vec!["ben".into()]).expect("expected a valid name");
        assert_eq!(shared.right_of(&ben), Some(SceneRight::Use));
        assert_eq!(shared.right_of(&principal("Ben", Role::Upload)), None);
        let public = private.share_with(vec![EVERYONE.into()]).expect("expected a valid name");
        assert_eq!(public.right_of(&principal("zoe", Role::Pixels)), Some(SceneRight::Use));
        assert!(matches!(public.check("a", &ben, SceneRight::Control), Err(Error::NotPermitted { .. })));
        assert!(public.check("a", &ben, SceneRight::Use).is_ok());
        assert!(matches!(
            shared.check("a", &principal("zoe", Role::Upload), SceneRight::Use),
            Err(Error::NotFound { .. })
        ));
    }

    #[test]
    fn names_of_shares_are_validated_and_limited() {
        let share = |names: Vec<String>| SceneAccess::new(&Principal::owner()).share_with(names);
        for name in ["", "a b", "\u{202e}", "**"] {
            let error = share(vec!["anna".into(), name.into()]).expect_err("expected an error").to_string();
            assert!(error.starts_with("principals[1]: "), "{error}");
        }
        assert!(share(vec!["x".into(); MAX_SHARES]).is_ok());
        assert!(share(vec!["x".into(); MAX_SHARES + 1]).is_err());
    }

    /// Catalogs of earlier versions stay readable, and scenes of the server's user are written as before.
    #[test]
    fn record_of_the_servers_user_is_that_of_earlier_versions() {
        let text = r#"{"kind":"repository","source":"tree"}"#;
        let record: SceneRecord = serde_json::from_str(text).expect("expected a record");
        assert_eq!(record.access, SceneAccess::new(&Principal::owner()));
        assert_eq!(serde_json::to_string(&record).expect("expected text"), text);
        let access = SceneAccess::new(&principal("anna", Role::Drive)).share_with(vec!["ben".into()]);
        let shared = SceneRecord { access: access.expect("expected a valid name"), ..record };
        let text = serde_json::to_string(&shared).expect("expected text");
        assert_eq!(text, r#"{"kind":"repository","source":"tree","owner":"anna","shared_with":["ben"]}"#);
        assert_eq!(serde_json::from_str::<SceneRecord>(&text).expect("expected a record"), shared);
    }
}
