//! Shared arrays of compute shaders are read within their bounds, also by lanes for which a condition is false.
//!
//! Mesa evaluates both operands of `&&` and `||` and all operands of `?:` if they have no side effects. In its software
//! renderer, a shared array is memory of the process without a check of bounds: a read beyond its end can end the
//! process. Therefore a condition on an index must be an `if` statement.

use std::path::Path;

/// The names of the shared arrays of a shader.
fn shared_arrays(shader: &str) -> Vec<&str> {
    let declarations = shader.lines().filter(|line| line.starts_with("shared "));
    declarations.filter_map(|line| line.split_once('[')?.0.split_whitespace().last()).collect()
}

/// Whether an index is a number or a named constant.
fn is_constant(index: &str) -> bool {
    let is_number = index.trim_end_matches('u').parse::<u32>().is_ok();
    is_number || index.chars().all(|character| character.is_ascii_uppercase() || character == '_')
}

/// The reads of shared arrays with a variable index that follow `&&`, `||` or `?` in the same expression.
fn conditional_reads(shader: &str) -> Vec<String> {
    let arrays = shared_arrays(shader);
    let code: String = shader.lines().map(|line| line.split("//").next().unwrap_or_default()).collect();
    let mut reads = Vec::new();
    // For each enclosing parenthesis, whether an operator came before in it.
    let mut follows_operator = vec![false];
    for (position, character) in code.char_indices() {
        let rest = &code[position..];
        match character {
            ';' | '{' | '}' => follows_operator = vec![false],
            '(' => follows_operator.push(false),
            ')' if follows_operator.len() > 1 => drop(follows_operator.pop()),
            '?' | '&' | '|' if ["?", "&&", "||"].iter().any(|operator| rest.starts_with(operator)) => {
                follows_operator.pop();
                follows_operator.push(true);
            }
            '[' if follows_operator.contains(&true) => {
                let name = code[..position].rsplit(|c: char| !c.is_alphanumeric() && c != '_').next();
                let index = rest[1..].split(']').next().unwrap_or_default();
                if name.is_some_and(|name| arrays.contains(&name)) && !is_constant(index) {
                    reads.push(format!("{}[{index}]", name.unwrap_or_default()));
                }
            }
            _ => {}
        }
    }
    reads
}

#[test]
fn shared_arrays_are_not_read_behind_a_condition_of_the_same_expression() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shaders");
    let mut array_count = 0;
    for entry in std::fs::read_dir(folder).expect("expected the folder of shaders") {
        let path = entry.expect("expected an entry").path();
        if path.extension().is_some_and(|extension| extension == "comp") {
            let shader = std::fs::read_to_string(&path).expect("expected a shader");
            array_count += shared_arrays(&shader).len();
            assert_eq!(conditional_reads(&shader), Vec::<String>::new(), "{}", path.display());
        }
    }
    assert!(array_count > 0, "expected shaders with shared arrays");
}

#[test]
fn conditional_reads_are_found() {
    let declaration = "shared uint counts[COUNT]; // comment\n";
    let reads = |statement: &str| conditional_reads(&format!("{declaration}void main() {{ {statement} }}"));
    assert_eq!(reads("if (lane < COUNT && counts[lane] > 0u) x = 1u;"), ["counts[lane]"]);
    assert_eq!(reads("x = lane >= s ? counts[lane - s] : 0u;"), ["counts[lane - s]"]);
    assert_eq!(reads("if (a && b) x = counts[lane];"), Vec::<String>::new());
    assert_eq!(reads("if (a && counts[COUNT] > 0u && counts[0u] > 0u && other[lane] > 0u) x = 1u;"), [""; 0]);
}
