//! Messages about features of a model that the loader does not support, without duplicates.

/// The largest number of stored remarks, so that a hostile file cannot flood the log.
const MOST: usize = 64;

/// Remarks in order of occurrence.
#[derive(Debug, Default)]
pub(super) struct Remarks {
    said: Vec<String>,
    unsaid: usize,
}

impl Remarks {
    /// Adds a remark unless it already exists.
    pub(super) fn add(&mut self, remark: String) {
        let remark = tidy(&remark, 240);
        match self.said.contains(&remark) {
            true => {}
            false if self.said.len() < MOST => self.said.push(remark),
            false => self.unsaid += 1,
        }
    }

    /// All remarks, and the number of remarks that exceeded the limit.
    pub(super) fn into_list(mut self) -> Vec<String> {
        if self.unsaid > 0 {
            self.said.push(format!("and {} more remarks", self.unsaid));
        }
        self.said
    }
}

/// Sanitizes text from a file for display: no control characters, at most `most` characters.
pub(super) fn tidy(text: &str, most: usize) -> String {
    text.chars().filter(|letter| !letter.is_control()).take(most).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_remark_is_made_once_and_a_flood_is_cut_and_counted() {
        let mut remarks = Remarks::default();
        (0..3).for_each(|_| remarks.add("same\u{1b}[31m".into()));
        (0..100).for_each(|index| remarks.add(format!("other {index}")));
        let list = remarks.into_list();
        assert_eq!((list.len(), list[0].as_str()), (MOST + 1, "same[31m"));
        assert_eq!(list[MOST], "and 37 more remarks");
    }
}
