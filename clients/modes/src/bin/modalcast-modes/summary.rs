//! The result on stdout.

use std::path::Path;

use modalcast_modes::large_motion::LargeMotion;
use modalcast_modes::modeling::to_hertz;
use modalcast_modes::{Modeling, ModelingParameters};
use serde_json::json;

/// Frequencies that the text lists.
const LISTED_FREQUENCIES: usize = 6;

/// Groups whose materials the text lists.
const LISTED_GROUPS: usize = 8;

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
        "tetrahedra": modeling.tetrahedra,
        "parts": modeling.parts,
        "rigid_modes": modeling.rigid_modes,
        "mass": modeling.mass,
        "size": modeling.size,
        "frequencies": frequencies,
        "frequency_errors": errors,
        "residuals": modeling.residuals,
        "linear_modes": modeling.large_motion.as_ref().map(|large_motion| large_motion.linear_modes),
        "safe_displacements": modeling.large_motion.as_ref().map(safe_displacements),
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
        names_of_materials(parameters, modeling),
        format_number(modeling.mass),
        listed.join(", ")
    );
    if let Some(worst) = modeling.frequency_errors.iter().copied().reduce(f64::max) {
        text.push_str(&format!("error     about {} % (estimate for the worst mode)\n", format_number(100.0 * worst)));
    }
    if let Some(large_motion) = &modeling.large_motion {
        let LargeMotion { linear_modes, .. } = large_motion;
        let displacements = safe_displacements(large_motion).into_iter().map(format_number).collect::<Vec<_>>();
        text.push_str(&format!(
            "large     {linear_modes} modes and {} derivatives, cubic forces in {}\n          safe displacements of the \
             modes: {} m (beyond, the material may collapse under compression)\n",
            count - linear_modes,
            out.with_extension("cub").display(),
            displacements.join(", ")
        ));
    }
    for remark in &modeling.remarks {
        text.push_str(&format!("remark    {remark}\n"));
    }
    text.push_str(&format!("written   {} (modalcast view {} shows it)\n", out.display(), out.display()));
    text
}

/// The largest displacement of each linear mode that is safe from collapse, meters.
fn safe_displacements(large_motion: &LargeMotion) -> Vec<f64> {
    large_motion.safe_ranges.iter().map(|range| range.displacement).collect()
}

/// The names of all materials with their groups.
fn names_of_materials(parameters: &ModelingParameters, modeling: &Modeling) -> String {
    if modeling.tetrahedra.is_some() {
        let listed = modeling.group_materials.iter().take(LISTED_GROUPS);
        let listed = listed.map(|(group, material)| format!("{} ({group})", material.name)).collect::<Vec<_>>();
        let more = modeling.group_materials.len() - listed.len();
        return listed.join(", ") + &if more > 0 { format!(" and {more} more") } else { String::new() };
    }
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
