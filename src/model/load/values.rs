//! The policy for values of model files, which all formats share.
//!
//! | value | out of range by rounding (1e-6) | further out of range | not finite |
//! |---|---|---|---|
//! | position of a vertex that a face uses | | | error with the face and the vertex |
//! | position of another vertex | | | replaced, remark |
//! | normal | normalized | normalized | computed from the faces, remark |
//! | texture coordinates | | | (0, 0), remark |
//! | color of a vertex or face, 0 to 1 | clamped | clamped, remark | white, remark |
//! | colors of vertices or faces, 0 to 255: half of the channels above 0 are above 2 | clamped | clamped, remark | white, remark |
//! | color, opacity or factor of a material, 0 to 1 | clamped | clamped, remark | default, remark |
//! | exponent of a material, 0 to 1e6 | clamped | clamped, remark | default, remark |
//! | displacement of a vertex that a face uses (morph target, U) | | | error with the vertex |
//!
//! The same holds for references and statements: an index of a vertex that does not exist is an error. An index of texture
//! coordinates or of a normal that do not exist, a face with fewer than three corners, and a statement of a material that is
//! not understood are ignored with a remark. In strict mode, each remark on such a value is an error.
//!
//! The program that wrote a value out of range by rounding meant the end of the range, so there is no remark.

use crate::error::{Result, invalid};

/// The largest distance to a range that is due to rounding, relative to the size of the range.
const ROUNDING: f32 = 1e-6;

/// The largest number of different corrections of one file.
const MAX_CORRECTIONS: usize = 64;

/// A vertex without a color in a file with colors. It becomes white without a remark.
pub(super) const MISSING_COLOR: [f32; 3] = [f32::NEG_INFINITY; 3];

/// Channels of colors of vertices above this value indicate a range of 0 to 255.
const MAX_UNIT_CHANNEL: f32 = 2.0;

/// A value that a loader has changed or ignored.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Correction {
    /// What has the value, such as `material 'oak': Kd`.
    pub(super) subject: String,
    /// The place in the file, such as `line 3`; empty if the subject is unique.
    pub(super) place: String,
    pub(super) expected: String,
    pub(super) given: String,
}

/// The values of one file that a loader has changed or ignored.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Corrections {
    /// The first correction of each subject and treatment, the treatment, and the number of such corrections.
    entries: Vec<CountedCorrection>,
    /// Remarks that are not errors in strict mode.
    notes: Vec<String>,
    /// Number of corrections beyond [`MAX_CORRECTIONS`].
    suppressed_count: usize,
}

#[derive(Debug, Clone, PartialEq)]
struct CountedCorrection {
    first: Correction,
    treatment: String,
    count: usize,
}

impl Corrections {
    /// Adds a correction. `describe` is called for the first correction of this subject and treatment.
    pub(super) fn add(&mut self, subject: &str, treatment: &str, describe: impl FnOnce() -> CorrectedValue) {
        let is_same = |entry: &&mut CountedCorrection| entry.first.subject == subject && entry.treatment == treatment;
        if let Some(entry) = self.entries.iter_mut().find(is_same) {
            entry.count += 1;
            return;
        }
        if self.entries.len() == MAX_CORRECTIONS {
            self.suppressed_count += 1;
            return;
        }
        let CorrectedValue { place, expected, given } = describe();
        let first = Correction { subject: subject.to_owned(), place, expected, given };
        self.entries.push(CountedCorrection { first, treatment: treatment.to_owned(), count: 1 });
    }

    /// Adds a remark on values that the format allows, which is no error in strict mode.
    pub(super) fn add_note(&mut self, note: String) {
        if !self.notes.contains(&note) {
            self.notes.push(note);
        }
    }

    /// All remarks.
    ///
    /// # Errors
    /// In strict mode, `Invalid` for the first correction.
    pub(super) fn remarks(&self, is_strict: bool) -> Result<Vec<String>> {
        if let Some(CountedCorrection { first, .. }) = self.entries.first().filter(|_| is_strict) {
            let Correction { subject, place, expected, given } = first;
            let field = if place.is_empty() { subject.clone() } else { format!("{place}: {subject}") };
            return Err(invalid(field, expected, format!("{given} (strict mode)")));
        }
        let remark = |CountedCorrection { first, treatment, count }: &CountedCorrection| {
            let Correction { subject, place, expected, given } = first;
            let place = if place.is_empty() { String::new() } else { format!(" ({place})") };
            let more = if *count > 1 { format!(" ({count} times)") } else { String::new() };
            format!("{subject}: expected {expected}, got {given}{place}: {treatment}{more}")
        };
        let mut remarks = self.notes.clone();
        remarks.extend(self.entries.iter().map(remark));
        if self.suppressed_count > 0 {
            remarks.push(format!("and {} more values out of range", self.suppressed_count));
        }
        Ok(remarks)
    }

    /// A number in a range. `None` for a number that is not finite, whose `default` is named in the remark.
    pub(super) fn in_range(&mut self, subject: &str, value: f32, [min, max]: [f32; 2], default: &str) -> Option<f32> {
        let describe = || CorrectedValue::new("", format!("{min} to {max}"), value);
        if !value.is_finite() {
            self.add(subject, default, describe);
            return None;
        }
        let limited = value.clamp(min, max);
        if (value - limited).abs() > ROUNDING * (max - min) {
            self.add(subject, &format!("{limited} is used"), describe);
        }
        Some(limited)
    }

    /// Colors with channels from 0 to 1. `None` if a channel is not finite.
    pub(super) fn color(&mut self, subject: &str, color: [f32; 3], default: &str) -> Option<[f32; 3]> {
        let [red, green, blue] = color.map(|channel| self.in_range(subject, channel, [0.0, 1.0], default));
        Some([red?, green?, blue?])
    }

    /// Replaces vectors that are not finite by zeros.
    pub(super) fn zero_non_finite<const N: usize>(
        &mut self,
        subject: &str,
        treatment: &str,
        vectors: &mut [[f32; N]],
        first_index: u64,
    ) {
        for (index, vector) in vectors.iter_mut().enumerate() {
            if vector.iter().any(|number| !number.is_finite()) {
                let place = format!("element {}", index as u64 + first_index);
                self.add(subject, treatment, || CorrectedValue::new(place, "finite numbers", format!("{vector:?}")));
                *vector = [0.0; N];
            }
        }
    }

    /// Converts the colors of all vertices to a range from 0 to 1.
    pub(super) fn vertex_colors(&mut self, colors: &mut [[f32; 3]], first_index: u64) {
        self.colors(["vertex", "vertices"], colors, first_index);
    }

    /// Converts the colors of all faces to a range from 0 to 1.
    pub(super) fn face_colors(&mut self, colors: &mut [[f32; 3]]) {
        self.colors(["face", "faces"], colors, 0);
    }

    /// `names` are the singular and the plural of the elements that have the colors.
    fn colors(&mut self, names: [&str; 2], colors: &mut [[f32; 3]], first_index: u64) {
        let [element, elements] = names;
        let channels = || colors.as_flattened().iter().filter(|channel| channel.is_finite() && **channel > 0.0);
        let large_count = channels().filter(|channel| **channel > MAX_UNIT_CHANNEL).count();
        let scale = if large_count > 0 && 2 * large_count >= channels().count() { 255.0 } else { 1.0 };
        if scale > 1.0 {
            self.add_note(format!("colors of {elements} are divided by 255, because they exceed 1"));
        }
        for (index, color) in colors.iter_mut().enumerate() {
            if *color == MISSING_COLOR {
                *color = [1.0; 3];
                continue;
            }
            let limited = color.map(|channel| if channel.is_finite() { channel.clamp(0.0, scale) } else { f32::NAN });
            let is_correct = |(channel, limited): (&f32, &f32)| (channel - limited).abs() <= ROUNDING * scale;
            if !color.iter().zip(&limited).all(is_correct) {
                let is_finite = limited.iter().all(|channel| channel.is_finite());
                let white = format!("the {element} is white");
                let treatment = if is_finite { "the channels are clamped" } else { &white };
                let place = format!("{element} {}", index as u64 + first_index);
                let expected = format!("0 to {scale}");
                let subject = format!("color of a {element}");
                self.add(&subject, treatment, || CorrectedValue::new(place, expected, format!("{color:?}")));
            }
            let is_finite = limited.iter().all(|channel| channel.is_finite());
            *color = if is_finite { limited.map(|channel| channel / scale) } else { [1.0; 3] };
        }
    }
}

/// Place, expected and given value of a [`Correction`].
#[derive(Debug)]
pub(super) struct CorrectedValue {
    place: String,
    expected: String,
    given: String,
}

impl CorrectedValue {
    pub(super) fn new(place: impl Into<String>, expected: impl Into<String>, given: impl ToString) -> Self {
        Self { place: place.into(), expected: expected.into(), given: given.to_string() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounding_is_clamped_silently_and_more_with_a_remark() {
        let mut corrections = Corrections::default();
        for (value, expected) in [(0.5, Some(0.5)), (1.000_000_2, Some(1.0)), (-1e-7, Some(0.0))] {
            assert_eq!(corrections.in_range("d", value, [0.0, 1.0], "1 is used"), expected);
        }
        assert_eq!(corrections.remarks(true), Ok(vec![]), "expected no correction of rounding");
        assert_eq!(corrections.in_range("d", 1.0001, [0.0, 1.0], "1 is used"), Some(1.0));
        assert_eq!(corrections.in_range("d", 7.0, [0.0, 1.0], "1 is used"), Some(1.0));
        assert_eq!(corrections.in_range("Ns", f32::NAN, [0.0, 1e6], "1 is used"), None);
        let remarks = corrections.remarks(false).expect("remarks");
        let expected =
            ["d: expected 0 to 1, got 1.0001: 1 is used (2 times)", "Ns: expected 0 to 1000000, got NaN: 1 is used"];
        assert_eq!(remarks, expected);
        let message = corrections.remarks(true).expect_err("strict mode").to_string();
        assert_eq!(message, "d: expected 0 to 1, got 1.0001 (strict mode)");
    }

    #[test]
    fn colors_of_vertices_have_one_range() {
        let corrected = |colors: &[[f32; 3]]| {
            let (mut corrections, mut colors) = (Corrections::default(), colors.to_vec());
            corrections.vertex_colors(&mut colors, 1);
            (colors, corrections.remarks(false).expect("remarks"))
        };
        let divided = "colors of vertices are divided by 255, because they exceed 1";
        let clamped = "color of a vertex: expected 0 to 1, got [1.0001, 0.0, 0.5] (vertex 2): the channels are clamped";
        let white = "color of a vertex: expected 0 to 1, got [NaN, 0.0, 0.0] (vertex 1): the vertex is white";
        let bright = "color of a vertex: expected 0 to 1, got [300.0, 0.5, 0.5] (vertex 2): the channels are clamped";
        for (colors, expected, remarks) in [
            (vec![[1.0, 0.5, 0.0], [1.0001, 0.0, 0.5]], vec![[1.0, 0.5, 0.0], [1.0, 0.0, 0.5]], vec![clamped]),
            (vec![[1.000_000_1, 0.0, 0.0]], vec![[1.0, 0.0, 0.0]], vec![]),
            (vec![[255.0, 0.0, 51.0], MISSING_COLOR], vec![[1.0, 0.0, 0.2], [1.0; 3]], vec![divided]),
            (vec![[127.5, 1.0, 63.75]], vec![[0.5, 1.0 / 255.0, 0.25]], vec![divided]),
            (vec![[f32::NAN, 0.0, 0.0], [0.0, 1.0, 0.0]], vec![[1.0; 3], [0.0, 1.0, 0.0]], vec![white]),
            (vec![[0.5; 3], [300.0, 0.5, 0.5]], vec![[0.5; 3], [1.0, 0.5, 0.5]], vec![bright]),
            (vec![[1.0, 0.0, 1.0]], vec![[1.0, 0.0, 1.0]], vec![]),
        ] {
            assert_eq!(corrected(&colors), (expected, remarks.into_iter().map(str::to_owned).collect()));
        }
    }
}
