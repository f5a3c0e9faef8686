//! Tuning of `deform`: the number of resident blocks per multiprocessor that each variant is compiled for.

/// The macro of the number of blocks.
const MIN_BLOCKS_DEFINE: &str = "MIN_BLOCKS_PER_SM";

/// First compute capability of the column [`MinBlocks::sm_90`].
const SM_90: (i32, i32) = (9, 0);

/// Resident blocks per multiprocessor of the variants that define all of `macros`.
struct MinBlocks {
    macros: &'static [&'static str],
    /// Compute capability below 9.0.
    before_sm_90: u32,
    /// Compute capability 9.0 and above.
    sm_90: u32,
}

const fn row(macros: &'static [&'static str], before_sm_90: u32, sm_90: u32) -> MinBlocks {
    MinBlocks { macros, before_sm_90, sm_90 }
}

/// A variant uses the first row whose macros it defines.
///
/// The compiler limits the registers of a thread so that this many blocks fit. More blocks hide more memory latency,
/// but a variant that needs more registers than the limit spills them.
///
/// The numbers were chosen with the report of `ptxas -v`: variants with more accumulators or outputs have fewer blocks,
/// and none spills. The test `nvrtc_compiles_every_kernel_without_spilling` repeats the measurement. One row differs by
/// architecture. With MODES and RIGID_NORMALS, NVRTC 13.0 reports no spills for 28 blocks (72 registers) on sm_90. It
/// reports spills of 16 bytes for 28 blocks on sm_80, and of 80 bytes for 32 blocks (64 registers) on sm_90.
const MIN_BLOCKS: [MinBlocks; 20] = [
    row(&["AXIS_PER_WARP"], 5, 5),
    row(&["ONE_ITEM_PER_LANE", "MODES"], 10, 10),
    row(&["SHEAR"], 16, 16),
    row(&["TILE_LIST"], 16, 16),
    row(&["MODES", "COMPENSATED_SUM", "STORE_INT8"], 16, 16),
    row(&["MODES", "COMPENSATED_SUM"], 20, 20),
    row(&["MODES", "RIGID_NORMALS", "STORE_INT8"], 20, 20),
    row(&["MODES", "NORMAL_MAPS", "FOLLOWERS"], 20, 20),
    row(&["MODES", "DISPLACEMENTS", "STORE_F16"], 20, 20),
    row(&["MODES", "DISPLACEMENTS", "STORE_BF16"], 20, 20),
    row(&["MODES", "DISPLACEMENTS", "STORE_INT8"], 20, 20),
    row(&["MODES", "DISPLACEMENTS", "RIGID_NORMALS"], 24, 24),
    row(&["MODES", "NORMAL_MAPS"], 24, 24),
    row(&["MODES", "RIGID_NORMALS", "STORE_F16"], 24, 24),
    row(&["MODES", "RIGID_NORMALS", "STORE_BF16"], 24, 24),
    row(&["MODES", "RIGID_NORMALS", "FOLLOWERS"], 24, 24),
    row(&["MODES"], 24, 28),
    row(&["DISPLACEMENTS"], 12, 12),
    row(&["RIGID_NORMALS", "FOLLOWERS"], 12, 12),
    row(&[], 16, 16),
];

/// Number of resident blocks per multiprocessor for which a variant is compiled.
fn min_blocks(defines: &[&str], capability: (i32, i32)) -> u32 {
    let has_all = |row: &&MinBlocks| row.macros.iter().all(|name| defines.contains(name));
    // The last row applies to every variant.
    let row = MIN_BLOCKS.iter().find(has_all).unwrap_or(&MIN_BLOCKS[MIN_BLOCKS.len() - 1]);
    if capability < SM_90 { row.before_sm_90 } else { row.sm_90 }
}

/// The macro definition that tunes a variant of `deform` for a device, for example `MIN_BLOCKS_PER_SM=16`.
pub(crate) fn deform_tuning(defines: &[&str], capability: (i32, i32)) -> String {
    format!("{MIN_BLOCKS_DEFINE}={}", min_blocks(defines, capability))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The numbers of [`MIN_BLOCKS`] by nested conditions, as an independent definition.
    fn min_blocks_by_conditions(defines: &[&str], capability: (i32, i32)) -> u32 {
        let has = |name: &str| defines.contains(&name);
        let has_16_bit_storage = has("STORE_F16") || has("STORE_BF16");
        if has("AXIS_PER_WARP") {
            5
        } else if has("ONE_ITEM_PER_LANE") && has("MODES") {
            10
        } else if has("SHEAR") || has("TILE_LIST") {
            16
        } else if has("MODES") {
            if has("COMPENSATED_SUM") && has("STORE_INT8") {
                16
            } else if has("COMPENSATED_SUM")
                || (has("RIGID_NORMALS") && has("STORE_INT8"))
                || (has("NORMAL_MAPS") && has("FOLLOWERS"))
                || (has("DISPLACEMENTS") && (has_16_bit_storage || has("STORE_INT8")))
            {
                20
            } else if (has("DISPLACEMENTS") && has("RIGID_NORMALS"))
                || has("NORMAL_MAPS")
                || (has("RIGID_NORMALS") && (has_16_bit_storage || has("FOLLOWERS")))
                || capability < (9, 0)
            {
                24
            } else {
                28
            }
        } else if has("DISPLACEMENTS") || (has("RIGID_NORMALS") && has("FOLLOWERS")) {
            12
        } else {
            16
        }
    }

    #[test]
    fn table_equals_the_conditions_for_every_variant() {
        let macros = [
            "MODES",
            "ONE_ITEM_PER_LANE",
            "AXIS_PER_WARP",
            "COMPENSATED_SUM",
            "DISPLACEMENTS",
            "RIGID_NORMALS",
            "NORMAL_MAPS",
            "SHEAR",
            "FOLLOWERS",
            "TILE_LIST",
        ];
        let mut used_numbers = std::collections::BTreeSet::new();
        for set in 0..1_u32 << macros.len() {
            for storage in [None, Some("STORE_F16"), Some("STORE_BF16"), Some("STORE_INT8")] {
                let selected = macros.iter().enumerate().filter(|(bit, _)| set >> bit & 1 == 1).map(|(_, name)| *name);
                let defines: Vec<&str> = selected.chain(storage).collect();
                for capability in [(7, 5), (8, 0), (8, 9), (9, 0), (12, 0)] {
                    let blocks = min_blocks(&defines, capability);
                    assert_eq!(blocks, min_blocks_by_conditions(&defines, capability), "{defines:?} {capability:?}");
                    used_numbers.insert(blocks);
                }
            }
        }
        assert!(used_numbers.into_iter().eq([5, 10, 12, 16, 20, 24, 28]), "expected every number of the table");
    }
}
