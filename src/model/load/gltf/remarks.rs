//! What a model asks for and this loader leaves out, in words, each said once.

/// The most remarks kept; a hostile file must not fill the log.
const MOST: usize = 64;

/// Remarks in the order in which they came up.
#[derive(Debug, Default)]
pub(super) struct Remarks {
    said: Vec<String>,
    unsaid: usize,
}

impl Remarks {
    /// Adds a remark unless it was made before.
    pub(super) fn add(&mut self, remark: String) {
        let remark = tidy(&remark, 240);
        match self.said.contains(&remark) {
            true => {}
            false if self.said.len() < MOST => self.said.push(remark),
            false => self.unsaid += 1,
        }
    }

    /// All remarks, and how many more there were.
    pub(super) fn into_list(mut self) -> Vec<String> {
        if self.unsaid > 0 {
            self.said.push(format!("and {} more remarks", self.unsaid));
        }
        self.said
    }
}

/// A text of the file as it may be shown: no control characters, at most `most` characters.
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
