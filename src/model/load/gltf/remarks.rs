//! Remarks about features of a model that the loader does not support, without duplicates.

use crate::error::Result;
use crate::escaping::escape_controls;
use crate::load::values::Corrections;

/// The largest number of stored remarks, so that a malicious file cannot flood the log.
const MAX_REMARKS: usize = 64;

/// Remarks in order of occurrence.
#[derive(Debug, Default)]
pub(super) struct ImportRemarks {
    remarks: Vec<String>,
    /// Values that were changed or ignored.
    pub(super) corrections: Corrections,
    /// Number of remarks that exceeded the limit.
    suppressed_count: usize,
}

impl ImportRemarks {
    /// Adds a remark unless it already exists.
    pub(super) fn add(&mut self, remark: String) {
        let remark = sanitize(&remark, 240);
        match self.remarks.contains(&remark) {
            true => {}
            false if self.remarks.len() < MAX_REMARKS => self.remarks.push(remark),
            false => self.suppressed_count += 1,
        }
    }

    /// All remarks, then a message with the number of remarks that exceeded the limit, then the corrections of values.
    ///
    /// # Errors
    /// In strict mode, `Invalid` for the first correction.
    pub(super) fn into_list(mut self, is_strict: bool) -> Result<Vec<String>> {
        if self.suppressed_count > 0 {
            self.remarks.push(format!("and {} more remarks", self.suppressed_count));
        }
        self.remarks.extend(self.corrections.remarks(is_strict)?);
        Ok(self.remarks)
    }
}

/// Text from a file for display: escaped, at most `max_characters` characters.
pub(super) fn sanitize(text: &str, max_characters: usize) -> String {
    escape_controls(text).chars().take(max_characters).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn remarks_are_unique_and_limited() {
        let mut remarks = ImportRemarks::default();
        (0..3).for_each(|_| remarks.add("same\u{1b}[31m".into()));
        (0..100).for_each(|index| remarks.add(format!("other {index}")));
        let list = remarks.into_list(true).expect("no corrections");
        assert_eq!((list.len(), list[0].as_str()), (MAX_REMARKS + 1, r"same\u{1b}[31m"));
        // 1 + 100 different remarks, of which 64 are stored.
        assert_eq!(list[MAX_REMARKS], "and 37 more remarks");
    }
}
