//! One step as a client sends it: parsed once against the scene, then trusted.

use std::collections::BTreeMap;

use super::Scene;
use crate::domain::Transform;
use crate::error::{Error, Result, invalid};

/// The bytes of a step off the wire, not yet believed.
#[derive(Debug, Clone, Default)]
pub struct RawUpdate {
    pub number: u64,
    pub time: f64,
    /// Domains whose coordinates follow in `q`; empty with bytes in `q` means all domains in order.
    pub q_domains: Vec<u32>,
    /// r little-endian f32 per named domain, concatenated. Any alignment.
    pub q: bytes::Bytes,
    /// Domains whose transforms follow; empty with bytes in `transforms` means all domains in order.
    pub transform_domains: Vec<u32>,
    /// Twelve little-endian f32 per named domain, concatenated. Any alignment.
    pub transforms: bytes::Bytes,
}

/// A domain, and the first number and the count of its coordinates among the values of a step.
type Part = (u32, usize, usize);

/// A step that fits its scene: every index in range, every length right, every number finite.
#[derive(Debug, Clone, PartialEq)]
pub struct Update {
    pub number: u64,
    pub time: f64,
    q: Vec<Part>,
    values: Vec<f32>,
    pub transforms: Vec<(u32, Transform)>,
}

impl Update {
    /// Parses a step against its scene.
    ///
    /// # Errors
    /// `Invalid` with the field, what was expected and what was given.
    pub fn parse(scene: &Scene, raw: &RawUpdate) -> Result<Self> {
        if !raw.time.is_finite() {
            return Err(invalid("step.time", "a finite number", raw.time));
        }
        let (q, values) = parse_q(scene, raw)?;
        let transforms = parse_transforms(scene, raw)?;
        Ok(Self { number: raw.number, time: raw.time, q, values, transforms })
    }

    /// Each domain whose coordinates change, with its r numbers.
    pub fn coordinates(&self) -> impl Iterator<Item = (usize, &[f32])> {
        self.q.iter().map(|(domain, first, count)| (*domain as usize, &self.values[*first..][..*count]))
    }

    /// This step after an older one, so that applying the result equals applying both in order.
    pub fn over(self, older: &Self) -> Self {
        let mut q: BTreeMap<u32, &[f32]> = BTreeMap::new();
        let mut transforms = BTreeMap::new();
        for step in [older, &self] {
            q.extend(step.coordinates().map(|(domain, values)| (domain as u32, values)));
            transforms.extend(step.transforms.iter().copied());
        }
        let mut merged = Self { number: self.number, time: self.time, q: vec![], values: vec![], transforms: vec![] };
        for (domain, values) in q {
            merged.q.push((domain, merged.values.len(), values.len()));
            merged.values.extend_from_slice(values);
        }
        merged.transforms = transforms.into_iter().collect();
        merged
    }
}

fn parse_q(scene: &Scene, raw: &RawUpdate) -> Result<(Vec<Part>, Vec<f32>)> {
    let everyone = raw.q_domains.is_empty() && !raw.q.is_empty();
    let domains = named(scene, "step.q_domains", &raw.q_domains, everyone)?;
    let mut expected = 0;
    let mut places = Vec::with_capacity(domains.len());
    for domain in domains {
        let rank = scene.layout.slots[domain as usize].rank;
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

fn parse_transforms(scene: &Scene, raw: &RawUpdate) -> Result<Vec<(u32, Transform)>> {
    let everyone = raw.transform_domains.is_empty() && !raw.transforms.is_empty();
    let domains = named(scene, "step.transform_domains", &raw.transform_domains, everyone)?;
    if raw.transforms.len() != 48 * domains.len() {
        let wanted = format!("{} bytes ({} transforms of 12 numbers)", 48 * domains.len(), domains.len());
        return Err(invalid("step.transforms", wanted, format!("{} bytes", raw.transforms.len())));
    }
    let parse = |(domain, bytes): (u32, &[u8])| {
        let name = || format!("step.transforms of domain '{}'", scene.domains[domain as usize].name);
        let mut entries = [0.0; 12];
        entries.copy_from_slice(&floats(bytes));
        let transform = Transform::new(entries).map_err(|error| error.within(&name()))?;
        if !scene.needs.shear && !transform.is_similarity() {
            return Err(invalid(
                name(),
                "no shear and one scale (the scene declares rigid transforms)",
                format!("{entries:?}"),
            ));
        }
        Ok((domain, transform))
    };
    domains.into_iter().zip(raw.transforms.chunks_exact(48)).map(parse).collect()
}

/// The domains that a list names, each once, or all of them.
fn named(scene: &Scene, field: &str, list: &[u32], everyone: bool) -> Result<Vec<u32>, Error> {
    let count = scene.domains.len();
    if everyone {
        return Ok((0..count as u32).collect());
    }
    if list.len() > count {
        return Err(invalid(field, format!("at most {count} indices"), list.len()));
    }
    // One bit per domain: a list of a million costs as much per index as one of ten.
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

/// Little-endian numbers at any alignment.
fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.chunks_exact(4).map(|word| f32::from_le_bytes([word[0], word[1], word[2], word[3]])).collect()
}
