//! Plans the cuBLAS products of a scene: which domains share a batch, their padding, and their memory layout. Pure
//! functions.

use std::collections::BTreeMap;

use serde::Serialize;

use super::library::GemmCall;
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{Scene, SceneState};

/// Ways to compute u = U q with cuBLAS.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum CublasMethod {
    /// One domain: `sgemv` with column-major U.
    SgemvColumns,
    /// One domain: `sgemv` with row-major U.
    SgemvRows,
    /// All domains padded to the largest one: one strided batched `sgemm`.
    Padded,
    /// As `Padded`, but one strided batched `sgemv`.
    PaddedGemv,
    /// Domains in buckets of similar rank and size, padded to a common size: one strided batched `sgemm` per bucket.
    Bucketed,
    /// As `Bucketed`, but one strided batched `sgemv` per bucket.
    BucketedGemv,
    /// Domains in groups of equal rank and size, without padding: one grouped batched `sgemm`.
    Grouped,
    /// Domains that are instances of one shape: one `sgemm` with one column of q per domain.
    Instances,
}

impl CublasMethod {
    /// All methods.
    pub const ALL: [Self; 8] = [
        Self::SgemvColumns,
        Self::SgemvRows,
        Self::Padded,
        Self::PaddedGemv,
        Self::Bucketed,
        Self::BucketedGemv,
        Self::Grouped,
        Self::Instances,
    ];

    /// Name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::SgemvColumns => "cublas_sgemv_columns",
            Self::SgemvRows => "cublas_sgemv_rows",
            Self::Padded => "cublas_padded",
            Self::PaddedGemv => "cublas_padded_gemv",
            Self::Bucketed => "cublas_bucketed",
            Self::BucketedGemv => "cublas_bucketed_gemv",
            Self::Grouped => "cublas_grouped",
            Self::Instances => "cublas_instances",
        }
    }

    /// Whether strided batched products use `sgemv` instead of `sgemm` with one column.
    pub(super) const fn uses_strided_gemv(self) -> bool {
        matches!(self, Self::PaddedGemv | Self::BucketedGemv)
    }

    /// Key of a domain with `rows` rows of U. Domains with equal keys share a batch. The key is the rank and the number
    /// of rows. Buckets round the rank up to a multiple of 8 and the rows up to a power of two. Methods with a single
    /// batch have a constant key.
    const fn batch_key(self, rows: usize, rank: usize) -> (usize, usize) {
        match self {
            Self::Bucketed | Self::BucketedGemv => (rank.next_multiple_of(8), rows.next_power_of_two()),
            Self::Grouped => (rank, rows),
            _ => (0, 0),
        }
    }
}

/// The operands of u = U q. They index arrays with one entry per operand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Operand {
    /// The matrix U.
    Matrix,
    /// The coordinates q.
    Q,
    /// The displacements u.
    Displacements,
}

/// Products of one size and their domains.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct GemmBatch {
    pub call: GemmCall,
    /// The domain of each product. With [`CublasMethod::Instances`], the domain of each column of the only product.
    pub domains: Vec<usize>,
    /// Offsets of the first U, q and u, in floats; indexed by [`Operand`].
    pub offsets: [u64; 3],
}

/// All products of a step.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct GemmPlan {
    pub batches: Vec<GemmBatch>,
    /// Total floats of U, q and u; indexed by [`Operand`].
    pub floats: [u64; 3],
}

impl GemmPlan {
    /// Plans the products of a scene.
    ///
    /// # Errors
    /// `Invalid` when `method` does not support the scene, or the scene is too large for the 32-bit integers of cuBLAS.
    pub(super) fn new(scene: &Scene, method: CublasMethod) -> Result<Self> {
        check_scene(scene, method)?;
        let mut groups: BTreeMap<(usize, usize), Vec<usize>> = BTreeMap::new();
        for (domain, domain_layout) in
            scene.layout.domains.iter().enumerate().filter(|(_, domain_layout)| domain_layout.rank > 0)
        {
            groups.entry(method.batch_key(3 * domain_layout.vertices, domain_layout.rank)).or_default().push(domain);
        }
        let (mut batches, mut floats) = (Vec::with_capacity(groups.len()), [0_u64; 3]);
        for domains in groups.into_values() {
            let call = size_product(scene, method, &domains)?;
            let matrices = if method == CublasMethod::Instances { 1 } else { domains.len() as u64 };
            let counts = [matrices, domains.len() as u64, domains.len() as u64];
            let offsets = floats;
            for ((total, stride), count) in floats.iter_mut().zip(call.strides).zip(counts) {
                // Every batch begins at a multiple of 16 bytes.
                *total = (*total + stride.unsigned_abs() * count).next_multiple_of(4);
            }
            batches.push(GemmBatch { call, domains, offsets });
        }
        Ok(Self { batches, floats })
    }

    /// Offset of each domain's u, in floats; `None` for domains without modes.
    pub(super) fn u_offsets(&self, domains: usize) -> Vec<Option<u64>> {
        let mut offsets = vec![None; domains];
        for batch in &self.batches {
            for (index, domain) in batch.domains.iter().enumerate() {
                offsets[*domain] = Some(batch.offset(index, Operand::Displacements));
            }
        }
        offsets
    }

    /// The coordinates of all domains, padded with zeros.
    pub(super) fn pack_q(&self, scene: &Scene, state: &SceneState) -> Vec<f32> {
        let mut packed = vec![0.0; self.floats[Operand::Q as usize] as usize];
        for batch in &self.batches {
            for (index, domain) in batch.domains.iter().enumerate() {
                let q = state.q_of(scene, *domain);
                packed[batch.offset(index, Operand::Q) as usize..][..q.len()].copy_from_slice(q);
            }
        }
        packed
    }
}

impl GemmBatch {
    /// Offset in floats of an operand of the domain at `index` of this batch.
    pub(super) fn offset(&self, index: usize, operand: Operand) -> u64 {
        self.offsets[operand as usize] + self.call.strides[operand as usize].unsigned_abs() * index as u64
    }

    /// U of one domain: row-major if `by_rows`, otherwise column-major and padded with zeros to the size of the batch.
    pub(super) fn pack_matrix(&self, scene: &Scene, domain: usize, by_rows: bool) -> Vec<f32> {
        let modes = &scene.shape_of(domain).modes;
        let (rows, rank) = (3 * modes.vertices(), modes.rank());
        if by_rows {
            return (0..rows).flat_map(|row| (0..rank).map(move |mode| modes.entry(row / 3, row % 3, mode))).collect();
        }
        let lead = self.call.lead as usize;
        let mut matrix = vec![0.0; lead * self.call.inner as usize];
        for (mode, column) in matrix.chunks_exact_mut(lead).take(rank).enumerate() {
            column[..rows].copy_from_slice(modes.column(mode));
        }
        matrix
    }
}

/// The product of a batch, sized by its largest domain.
fn size_product(scene: &Scene, method: CublasMethod, domains: &[usize]) -> Result<GemmCall> {
    let to_i32 = |number: usize| {
        i32::try_from(number).map_err(|_| invalid("scene.size", format!("at most {} for cuBLAS", i32::MAX), number))
    };
    let domain_layouts = || domains.iter().map(|domain| scene.layout.domains[*domain]);
    let rows = domain_layouts().map(|domain_layout| 3 * domain_layout.vertices).max().unwrap_or(0);
    let rank = domain_layouts().map(|domain_layout| domain_layout.rank).max().unwrap_or(0);
    // The leading dimension of U and u: floats per column. cuBLAS is fastest with columns aligned to 16 bytes.
    // Row-major storage has no padding.
    let lead = if method == CublasMethod::SgemvRows { rows } else { rows.next_multiple_of(4) };
    let (columns, count) = if method == CublasMethod::Instances { (domains.len(), 1) } else { (1, domains.len()) };
    // Floats from one U, q and u to the next.
    let strides = [lead as i64 * rank as i64, rank as i64, lead as i64];
    Ok(GemmCall {
        rows: to_i32(rows)?,
        inner: to_i32(rank)?,
        columns: to_i32(columns)?,
        lead: to_i32(lead)?,
        count: to_i32(count)?,
        strides,
    })
}

fn check_scene(scene: &Scene, method: CublasMethod) -> Result<()> {
    let domains = scene.domains.len();
    if !scene.features.modes {
        return Err(invalid("modes", format!("at least 1 for {}", method.name()), 0));
    }
    match method {
        CublasMethod::SgemvColumns | CublasMethod::SgemvRows if domains != 1 => {
            Err(invalid("scene.domains", format!("1 for {}", method.name()), domains))
        }
        CublasMethod::Instances if scene.domains.iter().any(|domain| domain.shape != scene.domains[0].shape) => {
            Err(invalid("scene.domains", "instances of one shape for cublas_instances", "several shapes"))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_compute::testing::{displacement_of, scene_and_state};

    /// Emulates cuBLAS on a batch: C = A B for strided matrices. `a` (U) is row-major if `by_rows`, otherwise
    /// column-major. `b` (q) and `c` (u) are column-major.
    fn multiply(batch: &GemmBatch, by_rows: bool, [a, b]: [&[f32]; 2], c: &mut [f32]) {
        let GemmCall { rows, inner, columns, lead, count, strides } = batch.call;
        let start_of = |first: u64, stride: i64, index: i32| first as usize + stride as usize * index as usize;
        for index in 0..count {
            let [a0, b0, c0] = [0, 1, 2].map(|operand| start_of(batch.offsets[operand], strides[operand], index));
            for (row, column) in
                (0..rows as usize).flat_map(|row| (0..columns as usize).map(move |column| (row, column)))
            {
                let entry = |mode: usize| match by_rows {
                    true => a[a0 + row * inner as usize + mode],
                    false => a[a0 + mode * lead as usize + row],
                };
                let q = |mode: usize| b[b0 + column * inner as usize + mode];
                c[c0 + column * lead as usize + row] = (0..inner as usize).map(|mode| entry(mode) * q(mode)).sum();
            }
        }
    }

    /// Compares u of every domain with U q in f64, and returns the plan.
    fn check_products(scene: &Scene, state: &SceneState, method: CublasMethod) -> GemmPlan {
        let plan = GemmPlan::new(scene, method).expect("a supported scene");
        let by_rows = method == CublasMethod::SgemvRows;
        let mut matrices = vec![0.0; plan.floats[Operand::Matrix as usize] as usize];
        for batch in &plan.batches {
            // Instances of one shape share one U.
            let matrix_count = if method == CublasMethod::Instances { 1 } else { batch.domains.len() };
            for (index, domain) in batch.domains.iter().enumerate().take(matrix_count) {
                let matrix = batch.pack_matrix(scene, *domain, by_rows);
                matrices[batch.offset(index, Operand::Matrix) as usize..][..matrix.len()].copy_from_slice(&matrix);
            }
        }
        let (q, mut u) =
            (plan.pack_q(scene, state), vec![f32::NAN; plan.floats[Operand::Displacements as usize] as usize]);
        for batch in &plan.batches {
            multiply(batch, by_rows, [&matrices, &q], &mut u);
        }
        for (domain, offset) in plan.u_offsets(scene.domains.len()).iter().enumerate() {
            assert_eq!(offset.is_some(), scene.rank_of(domain) > 0);
            let Some(offset) = offset else { continue };
            for vertex in 0..scene.layout.domains[domain].vertices {
                for (axis, want) in displacement_of(scene, state, domain, vertex).iter().enumerate() {
                    let got = f64::from(u[*offset as usize + 3 * vertex + axis]);
                    // Ten times the error bound of f32 sums of up to 12 products of numbers from -1 to 1.
                    assert!((got - want).abs() < 1e-4, "{} domain {domain} vertex {vertex}", method.name());
                }
            }
        }
        plan
    }

    #[test]
    fn every_method_gives_each_domain_its_u() {
        // Vertices, modes and triangles of each domain. Some domains have no modes.
        let shapes: Vec<_> = (0..30).map(|index| (1 + index * 11 % 40, index % 13, 1)).collect();
        let (many_domains, state) = scene_and_state(&shapes);
        let deformable = shapes.iter().filter(|(_, rank, _)| *rank > 0);
        let unpadded: u64 = deformable.clone().map(|(vertices, rank, _)| (3 * vertices * rank) as u64).sum();
        let matrix_floats =
            |method: CublasMethod| check_products(&many_domains, &state, method).floats[Operand::Matrix as usize];
        let (padded, bucketed, grouped) = (
            matrix_floats(CublasMethod::Padded),
            matrix_floats(CublasMethod::Bucketed),
            matrix_floats(CublasMethod::Grouped),
        );
        assert!(unpadded <= grouped && grouped < bucketed && bucketed < padded, "{grouped} {bucketed} {padded}");
        assert_eq!(check_products(&many_domains, &state, CublasMethod::Padded).batches.len(), 1);
        assert_eq!(
            check_products(&many_domains, &state, CublasMethod::Grouped).batches.len(),
            deformable.count(),
            "expected a group per domain, because all sizes differ"
        );
        let (one_domain, state) = scene_and_state(&[(23, 10, 1)]);
        for method in CublasMethod::ALL {
            let plan = check_products(&one_domain, &state, method);
            assert_eq!(plan.batches.len(), 1, "{}", method.name());
        }
    }

    #[test]
    fn instances_share_one_matrix_with_a_column_each() {
        use modalcast_model::scene::SceneParts;
        let (one_domain, _) = scene_and_state(&[(23, 10, 1)]);
        let mut parts = SceneParts::named("instances");
        parts.shapes = one_domain.shapes.clone();
        parts.materials = one_domain.materials.clone();
        parts.domains = vec![one_domain.domains[0].clone(); 16];
        let instances = Scene::new(parts).expect("a valid scene");
        let mut state = SceneState::rest(&instances);
        state.q.iter_mut().enumerate().for_each(|(index, q)| *q = (index as f32).sin());
        let plan = check_products(&instances, &state, CublasMethod::Instances);
        // The 3 x 23 = 69 rows are padded to 72. There is one U of 10 columns; q and u have 16 columns.
        assert_eq!(plan.floats, [72 * 10, 10 * 16, 72 * 16]);
        assert_eq!((plan.batches[0].call.columns, plan.batches[0].call.count), (16, 1));
    }

    #[test]
    fn rejects_unsupported_scenes_and_names_the_field() {
        let (two_shapes, _) = scene_and_state(&[(5, 2, 1), (5, 2, 1)]);
        for method in [CublasMethod::SgemvColumns, CublasMethod::SgemvRows, CublasMethod::Instances] {
            let error = GemmPlan::new(&two_shapes, method).expect_err("two shapes").to_string();
            assert!(error.starts_with("scene.domains") && error.contains(method.name()), "{error}");
        }
        let (rigid, _) = scene_and_state(&[(5, 0, 1)]);
        for method in CublasMethod::ALL {
            assert!(GemmPlan::new(&rigid, method).expect_err("no modes").to_string().starts_with("modes"));
        }
    }
}
