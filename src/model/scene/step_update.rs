//! One step: the values that a writer (the simulation that drives a scene) sends. It is validated once against its
//! scene, so that later code can rely on it. Large steps are validated on all cores.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::transform_format::{self, ParsedTransform};
use super::transform_roots::check_transform_targets;
use super::{Scene, TransformFormat};
use crate::domain::Transform;
use crate::error::{Error, Result, invalid};

/// Number of transforms from which they are parsed on all cores. Smaller steps are parsed on the calling thread: a step
/// of 914 transforms took 65 us there, and 98 us on another thread that had to be woken.
const PARALLEL_TRANSFORMS: usize = 4096;

/// A step as received, not yet validated.
#[derive(Debug, Clone, Default)]
pub struct RawStepUpdate {
    pub number: u64,
    pub time: f64,
    /// Domains whose coordinates are in `q`. If this is empty and `q` is not, `q` contains all domains in order, with
    /// or without those that share the coordinates of another one.
    pub q_domains: Vec<u32>,
    /// r little-endian f32 per domain of `q_domains`, concatenated. The bytes need no alignment.
    pub q: bytes::Bytes,
    /// Domains whose transforms are in `transforms`. If this is empty and `transforms` is not, `transforms` contains
    /// all transform roots in order.
    pub transform_domains: Vec<u32>,
    /// One little-endian transform per domain of `transform_domains`, concatenated. The bytes need no alignment.
    pub transforms: bytes::Bytes,
    pub transform_format: TransformFormat,
}

/// The coordinates of one domain within `StepUpdate::values`.
#[derive(Debug, Clone, Copy, PartialEq)]
struct CoordinateSpan {
    /// The domain that owns the coordinates, so that steps can be merged by domain.
    domain: u32,
    /// Index in `StepUpdate::values` of the first coordinate.
    first: usize,
    /// Number of coordinates, one per mode of the domain.
    rank: usize,
}

/// A validated step: every index is in range, every length matches, every number is finite.
#[derive(Debug, Clone, PartialEq)]
pub struct StepUpdate {
    pub number: u64,
    pub time: f64,
    spans: Vec<CoordinateSpan>,
    /// The coordinates of all spans, concatenated.
    values: Vec<f32>,
    /// The transforms of the step, relative to the scene's origin and rounded to f32. They act on rest positions
    /// relative to the pivot of the root ([`super::TransformRoots::pivot_of`]).
    pub transforms: Vec<(u32, Transform)>,
    /// The unrounded translations, relative to the scene's origin, of those domains of `transforms` that were given in
    /// f64 or have a pivot. They have the order of `transforms`.
    translations: Vec<(u32, [f64; 3])>,
}

impl StepUpdate {
    /// Size of the values of the step in memory, in bytes.
    pub const fn bytes(&self) -> usize {
        size_of_val(self.spans.as_slice())
            + size_of_val(self.values.as_slice())
            + size_of_val(self.transforms.as_slice())
            + size_of_val(self.translations.as_slice())
    }

    /// Validates a step against its scene.
    ///
    /// # Errors
    /// `Invalid` with the field, the expected and the given value.
    pub fn parse(scene: &Scene, raw: &RawStepUpdate) -> Result<Self> {
        if !raw.time.is_finite() {
            return Err(invalid("step.time", "a finite number", raw.time));
        }
        let (spans, values) = parse_coordinates(scene, raw)?;
        let (transforms, translations) = parse_transforms(scene, raw)?;
        Ok(Self { number: raw.number, time: raw.time, spans, values, transforms, translations })
    }

    /// Whether any translation is in f64.
    pub const fn has_f64_translations(&self) -> bool {
        !self.translations.is_empty()
    }

    /// Each domain with a new transform, and its translation relative to the scene's origin in the precision in which
    /// it was given.
    pub fn transform_updates(&self) -> impl Iterator<Item = (usize, Transform, [f64; 3])> {
        let mut f64_translations = self.translations.iter().peekable();
        self.transforms.iter().map(move |(domain, transform)| {
            let f64_translation = f64_translations.next_if(|(other_domain, _)| other_domain == domain);
            let translation =
                f64_translation.map_or_else(|| transform.translation().into(), |(_, translation)| *translation);
            (*domain as usize, *transform, translation)
        })
    }

    /// Each domain with new coordinates of its own, and its r numbers. Of several values for a domain, the last one counts.
    pub fn coordinates(&self) -> impl Iterator<Item = (usize, &[f32])> {
        self.spans.iter().map(|span| (span.domain as usize, &self.values[span.first..][..span.rank]))
    }

    /// Merges this step with an older one. Applying the result equals applying both in order.
    pub fn merged_with_older(self, older: &Self) -> Self {
        let mut coordinates: BTreeMap<u32, &[f32]> = BTreeMap::new();
        let mut transforms = BTreeMap::new();
        // A newer f32 translation of a domain replaces an older f64 translation.
        let mut translations = BTreeMap::new();
        for step in [older, &self] {
            coordinates.extend(step.coordinates().map(|(domain, values)| (domain as u32, values)));
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
            spans: vec![],
            values: vec![],
            transforms: transforms.into_iter().collect(),
            translations: translations.into_iter().collect(),
        };
        for (domain, values) in coordinates {
            merged.spans.push(CoordinateSpan { domain, first: merged.values.len(), rank: values.len() });
            merged.values.extend_from_slice(values);
        }
        merged
    }
}

/// Parses the coordinates of a step: the span of each domain, and the values of all spans.
fn parse_coordinates(scene: &Scene, raw: &RawStepUpdate) -> Result<(Vec<CoordinateSpan>, Vec<f32>)> {
    let is_for_all_domains = raw.q_domains.is_empty() && !raw.q.is_empty();
    let domains = match is_for_all_domains {
        true => domains_of_whole_q(scene, raw.q.len()),
        false => parse_domain_list(scene, "step.q_domains", &raw.q_domains)?,
    };
    let mut coordinate_count = 0;
    let mut spans = Vec::with_capacity(domains.len());
    for domain in domains {
        let rank = scene.layout.domains[domain as usize].rank;
        spans.push(CoordinateSpan { domain, first: coordinate_count, rank });
        coordinate_count += rank;
    }
    if raw.q.len() != 4 * coordinate_count {
        let domain = match spans.as_slice() {
            [span] => format!(" of domain '{}'", scene.domains[span.domain as usize].name),
            _ => String::new(),
        };
        let expected_bytes = format!("{} bytes ({coordinate_count} coordinates{domain})", 4 * coordinate_count);
        return Err(invalid("step.q", expected_bytes, format!("{} bytes", raw.q.len())));
    }
    let values = decode_f32_values(&raw.q);
    for CoordinateSpan { domain, first, rank } in &spans {
        if let Some(mode) = values[*first..][..*rank].iter().position(|number| !number.is_finite()) {
            let name = &scene.domains[*domain as usize].name;
            let given = format!("{} for mode {mode} of domain '{name}'", values[first + mode]);
            return Err(invalid(format!("step.q[{}]", first + mode), "a finite number", given));
        }
    }
    for span in &mut spans {
        span.domain = scene.layout.q_owner(span.domain);
    }
    Ok((spans, values))
}

/// The domains of a `q` without a list of domains: all domains if it has the length of their coordinates, else those
/// with coordinates of their own.
fn domains_of_whole_q(scene: &Scene, q_bytes: usize) -> Vec<u32> {
    let all_ranks: usize = scene.layout.domains.iter().map(|domain| domain.rank).sum();
    let has_all_domains = q_bytes == 4 * all_ranks;
    let indices = 0..scene.domains.len() as u32;
    indices.filter(|index| has_all_domains || scene.domains[*index as usize].shares_q_with.is_none()).collect()
}

/// The transforms of a step, and the translations that were given in f64, each with the index of its domain.
type ParsedTransforms = (Vec<(u32, Transform)>, Vec<(u32, [f64; 3])>);

fn parse_transforms(scene: &Scene, raw: &RawStepUpdate) -> Result<ParsedTransforms> {
    let is_for_all_roots = raw.transform_domains.is_empty() && !raw.transforms.is_empty();
    let domains = match is_for_all_roots {
        true => scene.transform_roots.domains().collect(),
        false => parse_domain_list(scene, "step.transform_domains", &raw.transform_domains)?,
    };
    check_transform_targets(&scene.transform_roots, &scene.domains, "step.transform_domains", &domains)?;
    let transform_bytes = raw.transform_format.bytes();
    if raw.transforms.len() != transform_bytes * domains.len() {
        let expected =
            format!("{} bytes ({} transforms of {transform_bytes})", transform_bytes * domains.len(), domains.len());
        return Err(invalid("step.transforms", expected, format!("{} bytes", raw.transforms.len())));
    }
    let origin = scene.origin.map(|meters| meters / scene.unit);
    let parse = |domain: u32, bytes: &[u8]| {
        let pivot = scene.transform_roots.pivot_of(scene.transform_roots.root_of(domain as usize));
        match raw.transform_format {
            TransformFormat::Affine => parse_affine(scene, bytes, pivot),
            TransformFormat::QuaternionXyzwF32 => transform_format::parse_quaternion_f32(bytes, pivot),
            TransformFormat::QuaternionXyzwF64 => transform_format::parse_quaternion_f64(bytes, origin, pivot),
        }
    };
    if domains.len() >= PARALLEL_TRANSFORMS {
        return parse_transforms_in_parallel(raw, &domains, !scene.transform_roots.pivots().is_empty(), parse);
    }
    let (mut transforms, mut translations) = (Vec::with_capacity(domains.len()), Vec::new());
    for (index, (domain, bytes)) in domains.into_iter().zip(raw.transforms.chunks_exact(transform_bytes)).enumerate() {
        let (transform, translation) = parse(domain, bytes).map_err(|error| in_transform(index, error))?;
        transforms.push((domain, transform));
        translations.extend(translation.map(|translation| (domain, translation)));
    }
    Ok((transforms, translations))
}

/// Parses the transforms of `domains` on all cores. The bytes have the right length.
fn parse_transforms_in_parallel(
    raw: &RawStepUpdate,
    domains: &[u32],
    has_pivots: bool,
    parse: impl Fn(u32, &[u8]) -> Result<ParsedTransform> + Sync,
) -> Result<ParsedTransforms> {
    let transform_bytes = raw.transform_format.bytes();
    let first_invalid = AtomicUsize::new(usize::MAX);
    let parse_or_note = |(index, (bytes, domain)): (usize, (&[u8], &u32))| {
        let (transform, translation) = parse(*domain, bytes).unwrap_or_else(|_| {
            first_invalid.fetch_min(index, Ordering::Relaxed);
            (Transform::IDENTITY, None)
        });
        ((*domain, transform), translation.map(|translation| (*domain, translation)))
    };
    let encoded_transforms = raw.transforms.par_chunks_exact(transform_bytes);
    let parsed = encoded_transforms.zip(domains).enumerate().map(parse_or_note);
    let (transforms, translations) = match raw.transform_format {
        TransformFormat::Affine | TransformFormat::QuaternionXyzwF32 if !has_pivots => {
            (parsed.map(|(transform, _)| transform).collect(), vec![])
        }
        _ => {
            let (transforms, translations): (Vec<_>, Vec<_>) = parsed.unzip();
            (transforms, translations.into_iter().flatten().collect())
        }
    };
    // Parsing the first invalid transform again gives its error.
    let first_invalid = first_invalid.into_inner();
    let mut encoded_transforms = raw.transforms.chunks_exact(transform_bytes).zip(domains);
    if let Some((bytes, domain)) = encoded_transforms.nth(first_invalid) {
        parse(*domain, bytes).map_err(|error| in_transform(first_invalid, error))?;
    }
    Ok((transforms, translations))
}

/// Names the transform in an error.
fn in_transform(index: usize, error: Error) -> Error {
    error.in_message(&format!("step.transforms[{index}]"))
}

/// Parses [`TransformFormat::Affine`], the only format that can contain shear or a non-uniform scale, and rejects both
/// in scenes without the feature `shear`.
fn parse_affine(scene: &Scene, bytes: &[u8], pivot: Option<[f64; 3]>) -> Result<ParsedTransform> {
    let (transform, translation) = transform_format::parse_affine(bytes, pivot)?;
    if !scene.features.shear && !transform.is_similarity() {
        let expected = "no shear and a uniform scale (the scene declares rigid transforms)";
        return Err(invalid("linear", expected, format!("{:?}", transform.0)));
    }
    Ok((transform, translation))
}

/// Validates a list of domain indices: in range and without duplicates.
fn parse_domain_list(scene: &Scene, field: &str, list: &[u32]) -> Result<Vec<u32>, Error> {
    let domain_count = scene.domains.len();
    if list.len() > domain_count {
        return Err(invalid(field, format!("at most {domain_count} indices"), list.len()));
    }
    // A bit set of all domains, because searching the list for duplicates would take quadratic time.
    let mut seen_bits = vec![0_u64; domain_count.div_ceil(64)];
    for (position, domain) in list.iter().enumerate() {
        let index = *domain as usize;
        if index >= domain_count {
            return Err(invalid(format!("{field}[{position}]"), format!("an index below {domain_count}"), domain));
        }
        let (word, bit) = (index / 64, 1 << (index % 64));
        if seen_bits[word] & bit != 0 {
            return Err(invalid(format!("{field}[{position}]"), "an index that was not named before", domain));
        }
        seen_bits[word] |= bit;
    }
    Ok(list.to_vec())
}

/// Decodes little-endian numbers at any alignment.
fn decode_f32_values(bytes: &[u8]) -> Vec<f32> {
    bytes.chunks_exact(4).map(|word| f32::from_le_bytes([word[0], word[1], word[2], word[3]])).collect()
}
