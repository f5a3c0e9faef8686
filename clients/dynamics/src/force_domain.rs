//! Finds the domain that a file of reduced forces belongs to. Forces of another model would move a domain in a wrong
//! way, and two models may have the same rank, so a domain is identified by its name, its modes, or the hash of the file in
//! a note.

use std::path::Path;

use modalcast_client::{Client, ContentHash, DescriptionRequest, Domain, SceneDescription, ShapeArray};

use sha2::{Digest as _, Sha256};

use crate::checkpoint::hexadecimal;
use crate::error::{Result, invalid_input};
use crate::model::DomainModel;
use crate::vega::read_modes_hash;

/// Extension of the file of modes next to a file of reduced forces.
const MODES_EXTENSION: &str = "URendering.float";

/// Name of the note with the SHA-256 of the file of reduced forces, 64 hexadecimal digits. `modalcast model` writes it.
const HASH_NOTE: &str = "modes.cubic_sha256";

/// Maximum number of domains that an error names.
const MAX_NAMED_DOMAINS: usize = 8;

/// Finds the index of the domain that the reduced forces in the file `cubic` with the content `bytes` act on: the one with
/// the name or index `selected`, or else the one whose U has the hash of the modes next to the file, or else, without such
/// modes, the one whose note has the hash of the file.
///
/// # Errors
/// `Client` if the scene does not exist or the file of modes cannot be read; `Invalid` if no domain is identified, or
/// several are.
pub async fn find_force_domain(
    client: &Client,
    scene: &str,
    selected: Option<&str>,
    cubic: &Path,
    bytes: &[u8],
) -> Result<usize> {
    if let Some(selected) = selected {
        return select_by_name(&client.describe(scene, &[]).await?, selected);
    }
    let modes_path = cubic.with_extension(MODES_EXTENSION);
    if !modes_path.is_file() {
        return select_by_note(&client.describe(scene, &[]).await?, bytes, &modes_path);
    }
    let hash = read_modes_hash(&modes_path)?;
    let description = client.describe_with(&DescriptionRequest::new(scene).hashes()).await?;
    select_by_modes(&description, &hash, &modes_path)
}

/// Selects a domain by its name, or by its index if no domain has this name.
fn select_by_name(description: &SceneDescription, selected: &str) -> Result<usize> {
    let domains = &description.domains;
    let named: Vec<&Domain> = domains.iter().filter(|domain| domain.name == selected).collect();
    match named[..] {
        [domain] => Ok(domain.index),
        [] => selected.parse().ok().filter(|index| *index < domains.len()).ok_or_else(|| {
            let expected = format!(
                "a name, or an index below {}: {}",
                domains.len(),
                list_domains(&domains.iter().collect::<Vec<_>>())
            );
            invalid_input("--domain", expected, format!("'{selected}'"))
        }),
        _ => Err(invalid_input(
            "--domain",
            "the index of one domain",
            format!("a name of several: {}", list_domains(&named)),
        )),
    }
}

/// Checks that the bytes of a file of reduced forces are those that were made with a domain's modes, if the domain has a
/// note with their hash.
///
/// # Errors
/// `Invalid` if the file is another one, such as that of an earlier model of the same name.
pub fn check_forces_belong(domain: &DomainModel, bytes: &[u8]) -> Result<()> {
    let Some(noted) = domain.notes.get(HASH_NOTE) else { return Ok(()) };
    let given = hexadecimal(&Sha256::digest(bytes));
    match noted.eq_ignore_ascii_case(&given) {
        true => Ok(()),
        false => {
            let field = format!("cubic forces of '{}'", domain.name);
            Err(invalid_input(field, format!("the file with the SHA-256 {noted}, made with these modes"), given))
        }
    }
}

/// Selects the domain with coordinates of its own whose note has the hash of the file of reduced forces.
fn select_by_note(description: &SceneDescription, bytes: &[u8], modes_path: &Path) -> Result<usize> {
    let hash = hexadecimal(&Sha256::digest(bytes));
    let is_noted = |domain: &&Domain| {
        let noted = domain.notes.get(HASH_NOTE);
        domain.shares_q_with.is_none() && noted.is_some_and(|noted| noted.eq_ignore_ascii_case(&hash))
    };
    let found: Vec<&Domain> = description.domains.iter().filter(is_noted).collect();
    if let [domain] = found[..] {
        return Ok(domain.index);
    }
    let expected = format!(
        "--domain NAME, the modes {} of these forces, or one domain whose note {HASH_NOTE} is the SHA-256 of the forces",
        modes_path.display()
    );
    let given = if found.is_empty() { "none of them".to_owned() } else { format!("several: {}", list_domains(&found)) };
    Err(invalid_input("domain", expected, given))
}

/// Selects the domain with coordinates of its own whose U has a hash.
fn select_by_modes(description: &SceneDescription, hash: &ContentHash, modes_path: &Path) -> Result<usize> {
    let has_modes = |domain: &&Domain| {
        let hashes = &description.shape_of(domain).hashes;
        domain.shares_q_with.is_none() && hashes.contains(&(ShapeArray::Modes, *hash))
    };
    let found: Vec<&Domain> = description.domains.iter().filter(has_modes).collect();
    if let [domain] = found[..] {
        return Ok(domain.index);
    }
    let expected = format!("one domain with the modes {}, or --domain NAME", modes_path.display());
    let given = match found.len() {
        0 => "no domain with these modes".to_owned(),
        _ => format!("several: {}", list_domains(&found)),
    };
    Err(invalid_input("domain", expected, given))
}

/// Indices and names of domains.
fn list_domains(domains: &[&Domain]) -> String {
    let mut names: Vec<String> = domains
        .iter()
        .take(MAX_NAMED_DOMAINS)
        .map(|domain| format!("'{}' (index {})", domain.name, domain.index))
        .collect();
    if domains.len() > names.len() {
        names.push(format!("and {} more", domains.len() - names.len()));
    }
    names.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hierarchy::tests::four_domain_model;
    use modalcast_client::Shape;

    /// Domains with these names, shapes and domains whose q they share. The modes of shape i have the hash [i; 32].
    fn description(domains: &[(&str, usize, Option<usize>)]) -> SceneDescription {
        let shape =
            |index: usize| Shape { index, hashes: vec![(ShapeArray::Modes, [index as u8; 32])], ..Shape::default() };
        let domains = domains.iter().enumerate().map(|(index, (name, shape, shares_q_with))| Domain {
            index,
            name: (*name).into(),
            shape: *shape,
            shares_q_with: *shares_q_with,
            ..Domain::default()
        });
        SceneDescription {
            shapes: (0..3).map(shape).collect(),
            domains: domains.collect(),
            ..SceneDescription::default()
        }
    }

    #[test]
    fn domain_is_selected_by_unique_name_or_index() {
        let scene = description(&[("a", 0, None), ("b", 1, None), ("b", 2, None), ("1", 0, None)]);
        for (selected, index) in [("a", 0), ("2", 2), ("1", 3)] {
            assert_eq!(select_by_name(&scene, selected).expect("a domain"), index, "{selected}");
        }
        let ambiguous = select_by_name(&scene, "b").expect_err("two domains").to_string();
        assert!(ambiguous.contains("'b' (index 1), 'b' (index 2)"), "{ambiguous}");
        for selected in ["c", "4", "-1", ""] {
            let error = select_by_name(&scene, selected).expect_err("no domain").to_string();
            assert!(error.contains("'a' (index 0)") && error.contains("index below 4"), "{error}");
        }
    }

    #[test]
    fn forces_of_another_model_are_rejected() {
        let mut domain = four_domain_model().domains.swap_remove(0);
        check_forces_belong(&domain, b"forces").expect("a domain without the note");
        domain.notes.insert(HASH_NOTE.into(), hexadecimal(&Sha256::digest(b"forces")));
        check_forces_belong(&domain, b"forces").expect("the same file");
        let error = check_forces_belong(&domain, b"others").expect_err("another file").to_string();
        assert!(error.contains("cubic forces of 'beam'"), "{error}");
    }

    #[test]
    fn domain_is_selected_by_the_hash_in_its_note() {
        let mut scene = description(&[("a", 0, None), ("b", 1, None), ("follower", 1, Some(1))]);
        let hash = hexadecimal(&Sha256::digest(b"forces"));
        for index in 1..3 {
            scene.domains[index].notes.insert(HASH_NOTE.into(), hash.clone());
        }
        let select =
            |scene: &SceneDescription, bytes: &[u8]| select_by_note(scene, bytes, Path::new("b.URendering.float"));
        assert_eq!(select(&scene, b"forces").expect("a domain"), 1);
        let missing = select(&scene, b"others").expect_err("no domain").to_string();
        assert!(missing.contains("--domain NAME") && missing.contains("b.URendering.float"), "{missing}");
        scene.domains[0].notes.insert(HASH_NOTE.into(), hash);
        let ambiguous = select(&scene, b"forces").expect_err("two domains").to_string();
        assert!(ambiguous.contains("'a' (index 0), 'b' (index 1)"), "{ambiguous}");
    }

    #[test]
    fn domain_is_selected_by_its_modes_and_ambiguity_is_an_error() {
        // The third domain has the q of the second one.
        let scene =
            description(&[("a", 0, None), ("b", 1, None), ("follower", 1, Some(1)), ("c", 2, None), ("d", 2, None)]);
        let select = |hash: u8| select_by_modes(&scene, &[hash; 32], Path::new("b.URendering.float"));
        assert_eq!((select(0).expect("a domain"), select(1).expect("a domain")), (0, 1));
        let ambiguous = select(2).expect_err("two domains").to_string();
        assert!(ambiguous.contains("'c' (index 3), 'd' (index 4)") && ambiguous.contains("--domain"), "{ambiguous}");
        let missing = select(3).expect_err("no domain").to_string();
        assert!(missing.contains("b.URendering.float") && missing.contains("--domain"), "{missing}");
    }
}
