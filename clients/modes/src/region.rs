//! Regions of a body that clamps hold.

use exmex::{Express as _, FlatExVal, Val};
use modalcast_model::error::{Result, invalid};
use nalgebra::Vector3;

/// The forms of a clamp, for error messages.
const FORMS: &str =
    "an expression of x, y and z such as 'z < 0.01' or 'x < 0 && y > 1', 'group NAME', or 'near X Y Z RADIUS'";

/// Limit on an expression. The time of the parser grows with the square of its length.
const MAX_EXPRESSION_BYTES: usize = 1000;

/// A region in the units and axes of the surface file.
#[derive(Debug, Clone)]
pub enum Region {
    /// Points for which an expression is true, and the expression's variables as indices of axes.
    Expression { expression: Box<FlatExVal<i32, f64>>, axes: Vec<usize> },
    /// Points near a point.
    Sphere { center: Vector3<f64>, radius: f64 },
    /// The triangles of a group, by its index. Contains no points of the volume.
    Group(u32),
}

impl Region {
    /// Reads a region. `groups` are the names of the surface's groups.
    ///
    /// # Errors
    /// `Invalid` if the text has none of the forms, or there is no such group.
    pub fn parse(text: &str, groups: &[String]) -> Result<Self> {
        let field = format!("--clamp '{text}'");
        if let Some(name) = text.trim().strip_prefix("group ") {
            let Some(index) = groups.iter().position(|group| group == name.trim()) else {
                return Err(invalid(field, format!("one of the groups {}", list_names(groups)), name.trim()));
            };
            return Ok(Self::Group(index as u32));
        }
        if let Some(numbers) = text.trim().strip_prefix("near ") {
            let values: Result<Vec<f64>, _> = numbers.split_whitespace().map(str::parse).collect();
            let values = values.unwrap_or_default();
            return match values[..] {
                [x, y, z, radius] if values.iter().all(|value| value.is_finite()) && radius > 0.0 => {
                    Ok(Self::Sphere { center: Vector3::new(x, y, z), radius })
                }
                _ => Err(invalid(field, "'near X Y Z RADIUS' with a radius above 0", format!("'{numbers}'"))),
            };
        }
        if text.len() > MAX_EXPRESSION_BYTES {
            return Err(invalid(field, format!("at most {MAX_EXPRESSION_BYTES} characters"), text.len()));
        }
        let expression =
            exmex::parse_val::<i32, f64>(&bind_operators(text)).map_err(|error| invalid(&field, FORMS, error))?;
        let axis_of = |name: &String| ["x", "y", "z"].iter().position(|axis| axis == name);
        let axes: Option<Vec<usize>> = expression.var_names().iter().map(axis_of).collect();
        let Some(axes) = axes else {
            return Err(invalid(field, FORMS, format!("the variables {}", expression.var_names().join(", "))));
        };
        let region = Self::Expression { expression: Box::new(expression), axes };
        match region.evaluate(Vector3::zeros()) {
            Some(_) => Ok(region),
            None => Err(invalid(field, "a condition, which is true or false", "a number")),
        }
    }

    /// Whether the region contains a point of the volume.
    pub fn contains(&self, point: Vector3<f64>) -> bool {
        self.evaluate(point).unwrap_or(false)
    }

    /// The value of the condition; `None` if it has none at this point.
    fn evaluate(&self, point: Vector3<f64>) -> Option<bool> {
        match self {
            Self::Group(_) => Some(false),
            Self::Sphere { center, radius } => Some((point - center).norm() <= *radius),
            Self::Expression { expression, axes } => {
                let values: Vec<Val<i32, f64>> = axes.iter().map(|axis| Val::Float(point[*axis])).collect();
                match expression.eval(&values) {
                    Ok(Val::Bool(value)) => Some(value),
                    _ => None,
                }
            }
        }
    }
}

/// The axes and constants of the comparisons `x < 1` in a region's text.
pub fn limits(text: &str) -> Vec<(usize, f64)> {
    let comparisons = text.split(['&', '|', '(', ')']);
    let limit = |comparison: &str| {
        let (name, constant) = comparison.split_once(['<', '>'])?;
        let axis = ["x", "y", "z"].iter().position(|axis| *axis == name.trim())?;
        Some((axis, constant.trim_start_matches('=').trim().parse().ok()?))
    };
    comparisons.filter_map(limit).collect()
}

/// Adds parentheses, so that comparisons bind more tightly than `&&`, and `&&` more tightly than `||`. The parser has
/// other priorities.
fn bind_operators(text: &str) -> String {
    let inner = expand_exponents(text)
        .replace('(', "(((")
        .replace(')', ")))")
        .replace("&&", ") && (")
        .replace("||", ")) || ((");
    format!("(({inner}))")
}

/// Replaces numbers such as `1e-6` and `2` by decimals with a point, which the parser reads as floats.
fn expand_exponents(text: &str) -> String {
    let mut expanded = String::new();
    let mut rest = text;
    while let Some(character) = rest.chars().next() {
        // The longest number that begins here, unless it continues a name.
        let is_number = character.is_ascii_digit() || character == '.';
        let continues_name = expanded.ends_with(|last: char| last.is_alphanumeric() || last == '_');
        let number = (1..=rest.len()).rev().filter(|_| is_number && !continues_name).find_map(|length| {
            let candidate =
                rest.get(..length).filter(|candidate| candidate.ends_with(|last: char| last.is_ascii_digit()))?;
            Some((length, candidate.parse::<f64>().ok()?))
        });
        let length = match number {
            Some((length, value)) => {
                let decimal = value.to_string();
                // Integers would be divided as integers.
                let suffix = if decimal.contains('.') { "" } else { ".0" };
                expanded.push_str(&format!("{decimal}{suffix}"));
                length
            }
            None => {
                expanded.push(character);
                character.len_utf8()
            }
        };
        rest = &rest[length..];
    }
    expanded
}

/// Names in quotation marks, for error messages.
pub fn list_names(names: &[String]) -> String {
    /// The largest number of names in a message.
    const MAX_LISTED: usize = 16;
    let quoted = names.iter().take(MAX_LISTED).map(|name| format!("'{name}'"));
    let listed = quoted.collect::<Vec<_>>().join(", ");
    if names.len() > MAX_LISTED { format!("{listed} and {} more", names.len() - MAX_LISTED) } else { listed }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn forms_of_regions_are_read() {
        let groups = ["foot".to_owned(), "upper arm".to_owned()];
        let contains = |text: &str, point: [f64; 3]| {
            Region::parse(text, &groups).unwrap_or_else(|error| panic!("{error}")).contains(point.into())
        };
        assert!(contains("z < 0.01", [5.0, 5.0, 0.0]) && !contains("z < 0.01", [0.0, 0.0, 0.02]));
        assert!(contains("z<-1 || x >= 2 && y > 1", [2.0, 1.5, 0.0]));
        assert!(!contains("(z<-1 || x >= 2) && y > 1", [0.0, 0.5, -2.0]));
        assert!(contains("x^2 + y^2 < 4", [1.0, -1.0, 9.0]));
        assert!(contains("x < 1e-6 && y > -2.5E3", [0.0; 3]) && !contains("x<1e-6", [1e-5, 0.0, 0.0]));
        assert!(contains("x < 1/2*200", [99.0, 0.0, 0.0]) && contains("x < 1e10", [3e9, 0.0, 0.0]));
        assert!(contains("near 1 2 -3 0.5", [1.0, 2.4, -3.0]) && !contains("near 1 2 -3 0.5", [1.0, 2.6, -3.0]));
        assert!(matches!(Region::parse("group upper arm", &groups), Ok(Region::Group(1))));
    }

    #[test]
    fn limits_are_the_constants_of_comparisons() {
        assert_eq!(limits("(z<-1e-3 || x >= 2) && y + x > 1"), [(2, -1e-3), (0, 2.0)]);
        assert!(limits("near 1 2 3 4").is_empty());
    }

    #[test]
    fn wrong_regions_name_the_forms() {
        let groups = ["foot".to_owned()];
        for (text, message) in [
            ("group hand", "one of the groups 'foot', got hand"),
            ("near 1 2 3", "radius above 0"),
            ("near 1 2 3 -1", "radius above 0"),
            ("near 1 foo 2 3 4", "radius above 0"),
            ("height < 1", "got the variables height"),
            ("z + 1", "a condition"),
            ("z <", "an expression of x, y and z"),
            ("", "an expression of x, y and z"),
        ] {
            let error = Region::parse(text, &groups).expect_err("expected an error").to_string();
            assert!(error.contains(message), "{text}: {error}");
        }
    }
}
