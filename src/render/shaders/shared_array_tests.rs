//! Shared arrays of compute shaders are read within their bounds, also by lanes for which a condition is false.
//!
//! Mesa evaluates both operands of `&&` and `||` and all operands of `?:` if they have no side effects. In its software
//! renderer, a shared array is memory of the process without bounds checks: a read beyond its end can end the process.
//! Therefore a condition on an index must be an `if` statement. The test reads the files of the compute shaders, in which
//! a declaration of a shared array is a line of its own.

use std::path::Path;

/// The names of the shared arrays of a shader.
fn shared_arrays(shader: &str) -> Vec<&str> {
    let declarations = shader.lines().filter(|line| line.trim_start().starts_with("shared "));
    declarations.filter_map(|line| line.split_once('[')?.0.split_whitespace().last()).collect()
}

/// Whether an index consists of numbers and named constants.
fn is_constant(index: &str) -> bool {
    let terms = index.split(|character: char| !character.is_alphanumeric() && character != '_');
    let is_number = |term: &str| term.trim_end_matches('u').parse::<u32>().is_ok();
    terms.filter(|term| !term.is_empty()).all(|term| is_number(term) || term == term.to_uppercase())
}

/// The names and variable indices of shared arrays that follow `&&`, `||` or `?` in the same expression.
fn conditional_reads(shader: &str) -> Vec<String> {
    let arrays = shared_arrays(shader);
    let code_lines = shader.lines().filter(|line| !line.starts_with('#'));
    let code: String = code_lines.map(|line| line.split("//").next().unwrap_or_default()).collect();
    let mut reads = Vec::new();
    // For each enclosing parenthesis, whether an operator came before in it.
    let mut follows_operator = vec![false];
    for (position, character) in code.char_indices() {
        let rest = &code[position..];
        match character {
            ';' | '{' | '}' => follows_operator = vec![false],
            '(' => follows_operator.push(false),
            ')' if follows_operator.len() > 1 => drop(follows_operator.pop()),
            ',' => {
                follows_operator.pop();
                follows_operator.push(false);
            }
            '?' | '&' | '|' if ["?", "&&", "||"].iter().any(|operator| rest.starts_with(operator)) => {
                follows_operator.pop();
                follows_operator.push(true);
            }
            '[' if follows_operator.contains(&true) => {
                let is_part_of_name = |character: char| character.is_alphanumeric() || character == '_';
                let name = code[..position].trim_end().rsplit(|character| !is_part_of_name(character)).next();
                let index = rest[1..].split([']', ';']).next().unwrap_or_default();
                if let Some(name) = name.filter(|name| arrays.contains(name) && !is_constant(index)) {
                    reads.push(format!("{name}[{index}]"));
                }
            }
            _ => {}
        }
    }
    reads
}

#[test]
fn shared_arrays_are_not_read_conditionally() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shaders");
    let mut all_arrays = Vec::new();
    for entry in std::fs::read_dir(folder).expect("expected the folder of shaders") {
        let path = entry.expect("expected an entry").path();
        if path.extension().is_some_and(|extension| extension == "comp") {
            let shader = std::fs::read_to_string(&path).expect("expected a shader");
            all_arrays.extend(shared_arrays(&shader).into_iter().map(str::to_owned));
            assert_eq!(conditional_reads(&shader), Vec::<String>::new(), "{}", path.display());
        }
    }
    for array in ["class_counts", "scan", "local_bins", "farthest", "depths"] {
        assert!(all_arrays.iter().any(|name| name == array), "expected the shared array {array}");
    }
}

#[test]
fn conditional_reads_are_found() {
    let reads = |statement: &str| {
        let declaration = "#if defined(A) && defined(B)\nshared uint counts[COUNT]; // comment\n#endif\n";
        conditional_reads(&format!("{declaration}void main() {{\n{statement}\n}}"))
    };
    assert_eq!(reads("if (lane < COUNT && counts[lane] > 0u) x = 1u;"), ["counts[lane]"]);
    assert_eq!(reads("x = lane >= s ? counts [lane - s] : 0u;"), ["counts[lane - s]"]);
    assert_eq!(reads("if (a && b) x = counts[lane];"), [""; 0]);
    assert_eq!(reads("f(a && b, counts[lane]);"), [""; 0]);
    assert_eq!(reads("if (a && counts[COUNT - 1u] > 0u && counts[0u] > 0u && other[lane] > 0u) x = 1u;"), [""; 0]);
}
