//! The result on stdout.

use std::path::Path;

use modalcast_modes::modeling::to_hertz;
use modalcast_modes::{Modeling, ModelingParameters};
use serde_json::json;

/// Frequencies that the text lists.
const LISTED_FREQUENCIES: usize = 6;

/// The result for other programs.
pub(crate) fn json(out: &Path, modeling: &Modeling) -> serde_json::Value {
    let frequencies: Vec<f64> = modeling.eigenvalues.iter().map(|eigenvalue| to_hertz(*eigenvalue)).collect();
    let errors: Vec<Option<f64>> =
        (0..frequencies.len()).map(|mode| modeling.frequency_errors.get(mode).copied()).collect();
    json!({
        "out": out.to_string_lossy(),
        "vertices": modeling.mesh.positions.len(),
        "freedoms": modeling.freedoms,
        "cell_size": modeling.cell_size,
        "parts": modeling.parts,
        "rigid_modes": modeling.rigid_modes,
        "mass": modeling.mass,
        "size": modeling.size,
        "frequencies": frequencies,
        "frequency_errors": errors,
        "residuals": modeling.residuals,
        "remarks": modeling.remarks,
    })
}

/// The result for people.
pub(crate) fn text(out: &Path, parameters: &ModelingParameters, modeling: &Modeling) -> String {
    let [x, y, z] = modeling.size.map(format_number);
    let count = modeling.eigenvalues.len();
    let listed: Vec<String> = modeling
        .eigenvalues
        .iter()
        .take(LISTED_FREQUENCIES)
        .map(|eigenvalue| format_number(to_hertz(*eigenvalue)))
        .collect();
    let more = if count > listed.len() { ", ..." } else { "" };
    let mut text = format!(
        "size      {x} x {y} x {z} m\nmaterial  {}, mass {} kg\nmodes     {count}, at {}{more} Hz\n",
        names_of_materials(parameters),
        format_number(modeling.mass),
        listed.join(", ")
    );
    if let Some(worst) = modeling.frequency_errors.iter().copied().reduce(f64::max) {
        text.push_str(&format!("error     about {} % (estimate for the worst mode)\n", format_number(100.0 * worst)));
    }
    for remark in &modeling.remarks {
        text.push_str(&format!("remark    {remark}\n"));
    }
    text.push_str(&format!("written   {} (modalcast view {} shows it)\n", out.display(), out.display()));
    text
}

/// The names of all materials, without repetitions.
fn names_of_materials(parameters: &ModelingParameters) -> String {
    let others = parameters.group_materials.iter().map(|(group, material)| format!("{} ({group})", material.name));
    std::iter::once(parameters.material.name.clone()).chain(others).collect::<Vec<_>>().join(", ")
}

/// A number with four significant digits.
fn format_number(number: f64) -> String {
    let exponent = number.abs().log10().floor();
    match exponent {
        -3.0..=5.0 => format!("{number:.*}", (3.0 - exponent).max(0.0) as usize),
        _ => format!("{number:.3e}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_four_digits() {
        let texts = [206.123_45, 0.012_345, 1_234_567.0, 99_999.0, 1e-7].map(format_number);
        assert_eq!(texts, ["206.1", "0.01235", "1.235e6", "99999", "1.000e-7"]);
    }
}
