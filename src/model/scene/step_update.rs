//! One step of a writer. It is validated once against its scene, so that later code can rely on it.

use std::collections::BTreeMap;

use super::transform_format::{self, ParsedTransform};
use super::transform_roots::check_transform_targets;
use super::{Scene, TransformFormat};
use crate::domain::Transform;
use crate::error::{Error, Result, invalid};

/// A step as received, not yet validated.
#[derive(Debug, Clone, Default)]
pub struct RawStepUpdate {
    pub number: u64,
    pub time: f64,
    /// Domains whose coordinates are in `q`. If empty while `q` is not, all domains in order.
    pub q_domains: Vec<u32>,
    /// r little-endian f32 per named domain, concatenated, at any alignment.
    pub q: bytes::Bytes,
    /// Domains whose transforms are in `transforms`. If empty while `transforms` is not, all transform roots in order
    /// (domains that follow no other).
    pub transform_domains: Vec<u32>,
    /// One transform per named domain in `transform_format`, little-endian, concatenated, at any alignment.
    pub transforms: bytes::Bytes,
    pub transform_format: TransformFormat,
}

/// A domain, and the offset and number of its coordinates in `StepUpdate::values`.
type CoordinateSpan = (u32, usize, usize);

/// A validated step: every index is in range, every length matches, every number is finite.
#[derive(Debug, Clone, PartialEq)]
pub struct StepUpdate {
    pub number: u64,
    pub time: f64,
    q: Vec<CoordinateSpan>,
    values: Vec<f32>,
    /// The transform of each named domain relative to the scene's origin, rounded to f32.
    pub transforms: Vec<(u32, Transform)>,
    /// For the domains of `transforms` with an f64 translation, in the same order: the unrounded translation relative
    /// to the scene's origin.
    translations: Vec<(u32, [f64; 3])>,
}

impl StepUpdate {
    /// Validates a step against its scene.
    ///
    /// # Errors
    /// `Invalid` with the field, the expected and the given value.
    pub fn parse(scene: &Scene, raw: &RawStepUpdate) -> Result<Self> {
        if !raw.time.is_finite() {
            return Err(invalid("step.time", "a finite number", raw.time));
        }
        let (q, values) = parse_q(scene, raw)?;
        let (transforms, translations) = parse_transforms(scene, raw)?;
        Ok(Self { number: raw.number, time: raw.time, q, values, transforms, translations })
    }

    /// Whether any translation was given in f64.
    pub const fn has_f64_translations(&self) -> bool {
        !self.translations.is_empty()
    }

    /// Each domain with a new transform, and its translation relative to the scene's origin in the precision in which
    /// it was given.
    pub fn transform_updates(&self) -> impl Iterator<Item = (usize, Transform, [f64; 3])> {
        let mut exact = self.translations.iter().peekable();
        self.transforms.iter().map(move |(domain, transform)| {
            let given = exact.next_if(|(parse_domain_list, _)| parse_domain_list == domain);
            let translation = given.map_or_else(|| transform.translation().into(), |(_, translation)| *translation);
            (*domain as usize, *transform, translation)
        })
    }

    /// Each domain with new coordinates, and its r numbers.
    pub fn coordinates(&self) -> impl Iterator<Item = (usize, &[f32])> {
        self.q.iter().map(|(domain, first, count)| (*domain as usize, &self.values[*first..][..*count]))
    }

    /// Merges this step with an older one. Applying the result equals applying both in order.
    pub fn merged_after(self, older: &Self) -> Self {
        let mut q: BTreeMap<u32, &[f32]> = BTreeMap::new();
        let mut transforms = BTreeMap::new();
        // A newer f32 translation of a domain replaces an older f64 translation.
        let mut translations = BTreeMap::new();
        for step in [older, &self] {
            q.extend(step.coordinates().map(|(domain, values)| (domain as u32, values)));
            transforms.extend(step.transforms.iter().copied());
            if !translations.is_empty() {
                for (domain, _) in &step.transforms {
                    translations.remove(domain);
                }
            }
            translations.extend(step.translations.iter().copied());
        }
        let mut merged = Self {
            number: self.number,
            time: self.time,
            q: vec![],
            values: vec![],
            transforms: transforms.into_iter().collect(),
            translations: translations.into_iter().collect(),
        };
        for (domain, values) in q {
            merged.q.push((domain, merged.values.len(), values.len()));
            merged.values.extend_from_slice(values);
        }
        merged
    }
}

fn parse_q(scene: &Scene, raw: &RawStepUpdate) -> Result<(Vec<CoordinateSpan>, Vec<f32>)> {
    let everyone = raw.q_domains.is_empty() && !raw.q.is_empty();
    let domains = match everyone {
        true => (0..scene.domains.len() as u32).collect(),
        false => parse_domain_list(scene, "step.q_domains", &raw.q_domains)?,
    };
    let mut expected = 0;
    let mut places = Vec::with_capacity(domains.len());
    for domain in domains {
        let rank = scene.layout.domains[domain as usize].rank;
        places.push((domain, expected, rank));
        expected += rank;
    }
    if raw.q.len() != 4 * expected {
        let field = match places.as_slice() {
            [(domain, ..)] => format!("step.q of domain '{}'", scene.domains[*domain as usize].name),
            _ => "step.q".into(),
        };
        let wanted = format!("{} bytes ({expected} coordinates)", 4 * expected);
        return Err(invalid(field, wanted, format!("{} bytes", raw.q.len())));
    }
    let values = floats(&raw.q);
    for (domain, first, rank) in &places {
        if let Some(mode) = values[*first..][..*rank].iter().position(|number| !number.is_finite()) {
            let field = format!("step.q of domain '{}', mode {mode}", scene.domains[*domain as usize].name);
            return Err(invalid(field, "a finite number", values[first + mode]));
        }
    }
    Ok((places, values))
}

/// Transforms of the named domains, and the f64 translations among them.
type ParsedTransforms = (Vec<(u32, Transform)>, Vec<(u32, [f64; 3])>);

fn parse_transforms(scene: &Scene, raw: &RawStepUpdate) -> Result<ParsedTransforms> {
    let everyone = raw.transform_domains.is_empty() && !raw.transforms.is_empty();
    let domains = match everyone {
        true => scene.transform_roots.domains().collect(),
        false => parse_domain_list(scene, "step.transform_domains", &raw.transform_domains)?,
    };
    check_transform_targets(&scene.transform_roots, &scene.domains, ("step.transform_domains", &domains))?;
    let size = raw.transform_format.bytes();
    if raw.transforms.len() != size * domains.len() {
        let wanted = format!("{} bytes ({} transforms of {size})", size * domains.len(), domains.len());
        return Err(invalid("step.transforms", wanted, format!("{} bytes", raw.transforms.len())));
    }
    let origin = scene.origin.map(|meters| meters / scene.unit);
    let (mut transforms, mut translations) = (Vec::with_capacity(domains.len()), Vec::new());
    for (domain, bytes) in domains.into_iter().zip(raw.transforms.chunks_exact(size)) {
        let parsed = match raw.transform_format {
            TransformFormat::Affine => parse_affine(scene, bytes),
            TransformFormat::RigidF32 => transform_format::parse_rigid_f32(bytes),
            TransformFormat::RigidF64 => transform_format::parse_rigid_f64(bytes, origin),
        };
        let name = || format!("step.transforms of domain '{}'", scene.domains[domain as usize].name);
        let (transform, translation) = parsed.map_err(|error| error.prefix_field(&name()))?;
        transforms.push((domain, transform));
        translations.extend(translation.map(|translation| (domain, translation)));
    }
    Ok((transforms, translations))
}

/// Parses the only format that can contain shear.
fn parse_affine(scene: &Scene, bytes: &[u8]) -> Result<ParsedTransform> {
    let (transform, kept) = transform_format::parse_affine(bytes)?;
    if !scene.features.shear && !transform.is_similarity() {
        let expected = "no shear and one scale (the scene declares rigid transforms)";
        return Err(invalid("linear", expected, format!("{:?}", transform.0)));
    }
    Ok((transform, kept))
}

/// Validates a list of domain indices: in range and without duplicates.
fn parse_domain_list(scene: &Scene, field: &str, list: &[u32]) -> Result<Vec<u32>, Error> {
    let count = scene.domains.len();
    if list.len() > count {
        return Err(invalid(field, format!("at most {count} indices"), list.len()));
    }
    // A bit set keeps the cost per index independent of the length of the list.
    let mut seen = vec![0_u64; count.div_ceil(64)];
    for (at, domain) in list.iter().enumerate() {
        let index = *domain as usize;
        if index >= count {
            return Err(invalid(format!("{field}[{at}]"), format!("an index below {count}"), domain));
        }
        let (word, bit) = (index / 64, 1 << (index % 64));
        if seen[word] & bit != 0 {
            return Err(invalid(format!("{field}[{at}]"), "an index that was not named before", domain));
        }
        seen[word] |= bit;
    }
    Ok(list.to_vec())
}

/// Decodes little-endian numbers at any alignment.
fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.chunks_exact(4).map(|word| f32::from_le_bytes([word[0], word[1], word[2], word[3]])).collect()
}
