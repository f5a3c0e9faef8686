//! The structs of `kernels/layout.cuh`, field by field; both sides assert the sizes, tests compare the offsets.

use bytemuck::{Pod, Zeroable};
use cudarc::driver::DeviceRepr;

/// Threads of a block, and the packed vertices or corners that one block computes.
pub(super) const BLOCK: u32 = 256;

/// `first_tangent` of a shape without tangents.
pub(super) const NO_TANGENTS: u32 = u32::MAX;

/// Where the vertices of one domain lie.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(super) struct VertexSlot {
    pub first_entry: u64,
    pub first: u32,
    pub stride: u32,
    pub rank: u32,
    pub first_q: u32,
}

/// Where the corners of one domain lie.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(super) struct CornerSlot {
    pub first: u32,
    pub first_normal: u32,
    pub first_tangent: u32,
}

/// Arguments of `deform`; pointers are device addresses.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(super) struct DeformArgs {
    pub slots: u64,
    pub first_domains: u64,
    pub columns: u64,
    pub transforms: u64,
    pub q: u64,
    pub positions: u64,
    pub bounds: u64,
    pub vertices: u32,
    pub reserved: u32,
}

/// Arguments of `orient`; pointers are device addresses.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(super) struct OrientArgs {
    pub slots: u64,
    pub first_domains: u64,
    pub rest_normals: u64,
    pub rest_tangents: u64,
    pub transforms: u64,
    pub normals: u64,
    pub tangents: u64,
    pub corners: u32,
    pub rest_corners: u32,
}

const _: () = assert!(size_of::<VertexSlot>() == 24, "VertexSlot differs from kernels/layout.cuh");
const _: () = assert!(size_of::<CornerSlot>() == 12, "CornerSlot differs from kernels/layout.cuh");
const _: () = assert!(size_of::<DeformArgs>() == 64, "DeformArgs differs from kernels/layout.cuh");
const _: () = assert!(size_of::<OrientArgs>() == 64, "OrientArgs differs from kernels/layout.cuh");

// SAFETY: repr(C) without padding or Rust references, laid out as the struct of the same name in kernels/layout.cuh.
unsafe impl DeviceRepr for DeformArgs {}
// SAFETY: as above.
unsafe impl DeviceRepr for OrientArgs {}

/// A size or an offset that both sides must agree on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Agreement {
    /// The C++ expression, e.g. `OFFSET(VertexSlot, rank)`.
    pub expression: String,
    /// Its value on the host.
    pub host: u32,
}

macro_rules! agreements {
    ($($of:ident { $($field:ident),* })*) => {
        vec![$(
            Agreement { expression: concat!("sizeof(", stringify!($of), ")").into(), host: size_of::<$of>() as u32 },
            $(Agreement {
                expression: concat!("OFFSET(", stringify!($of), ", ", stringify!($field), ")").into(),
                host: std::mem::offset_of!($of, $field) as u32,
            },)*
        )*]
    };
}

/// Every size, offset and constant that host and device share, with the host's value.
pub fn agreements() -> Vec<Agreement> {
    let mut list = agreements! {
        VertexSlot { first_entry, first, stride, rank, first_q }
        CornerSlot { first, first_normal, first_tangent }
        DeformArgs { slots, first_domains, columns, transforms, q, positions, bounds, vertices, reserved }
        OrientArgs {
            slots, first_domains, rest_normals, rest_tangents, transforms, normals, tangents, corners, rest_corners
        }
    };
    list.push(Agreement { expression: "BLOCK".into(), host: BLOCK });
    list.push(Agreement { expression: "NO_TANGENTS".into(), host: NO_TANGENTS });
    list
}

/// The start of a source that states agreements: NVRTC has no `offsetof`, so this is what that macro expands to.
pub(super) const PRELUDE: &str = "#include \"layout.cuh\"\n#define OFFSET(of, field) __INTADDR__(&(((of*)0)->field))\n";

/// A kernel `report` that writes the device's value of every agreement, in order, into its only argument.
pub(super) fn report_source() -> String {
    let line = |(index, agreement): (usize, &Agreement)| {
        format!("    values[{index}] = (unsigned)({});\n", agreement.expression)
    };
    let lines: String = agreements().iter().enumerate().map(line).collect();
    format!("{PRELUDE}extern \"C\" __global__ void report(unsigned* values) {{\n{lines}}}\n")
}
