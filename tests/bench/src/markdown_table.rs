//! Writes Markdown tables.

/// A table with a header. Cells may contain `|`, which is escaped.
pub(crate) fn table<R: IntoIterator<Item = String>>(head: &[&str], rows: impl IntoIterator<Item = R>) -> String {
    let mut text = line(head.iter().map(ToString::to_string));
    text.push_str(&format!("|{}\n", "---|".repeat(head.len())));
    text.extend(rows.into_iter().map(line));
    text
}

/// Placeholder for a missing value.
pub(crate) fn dash() -> String {
    "-".into()
}

fn line(cells: impl IntoIterator<Item = String>) -> String {
    let cells: Vec<String> = cells.into_iter().map(|cell| cell.replace('|', "\\|")).collect();
    format!("| {} |\n", cells.join(" | "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn writes_header_rule_and_escaped_cells() {
        let rows = [["1".to_owned(), "a|b".to_owned()], ["2".to_owned(), dash()]];
        assert_eq!(table(&["n", "text"], rows), "| n | text |\n|---|---|\n| 1 | a\\|b |\n| 2 | - |\n");
        assert_eq!(table(&["n"], Vec::<[String; 1]>::new()), "| n |\n|---|\n");
    }
}
