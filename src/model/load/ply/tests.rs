//! Tests of the PLY loader.

use super::*;

const HEADER: &str = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\n\
     property uchar green\nproperty uchar blue\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n";

const POSITIONS: [[f32; 3]; 4] = [[0.0; 3], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, -0.5]];
const COLORS: [[u8; 3]; 4] = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255; 3]];

fn ascii() -> String {
    let vertices = POSITIONS.iter().zip(COLORS).map(|([x, y, z], [r, g, b])| format!("{x} {y} {z} {r} {g} {b}\n"));
    let faces = "3 0 1 2\n3 0 2 3\n";
    format!("ply\nformat ascii 1.0\ncomment made by hand\n{HEADER}{}{faces}", vertices.collect::<String>())
}

fn binary(is_little_endian: bool) -> Vec<u8> {
    let format = if is_little_endian { "binary_little_endian" } else { "binary_big_endian" };
    let mut bytes = format!("ply\nformat {format} 1.0\n{HEADER}").into_bytes();
    let order = |bytes: [u8; 4]| if is_little_endian { bytes } else { [bytes[3], bytes[2], bytes[1], bytes[0]] };
    for (position, color) in POSITIONS.iter().zip(COLORS) {
        bytes.extend(position.iter().flat_map(|number| order(number.to_le_bytes())));
        bytes.extend(color);
    }
    for face in [[0_i32, 1, 2], [0, 2, 3]] {
        bytes.push(3);
        bytes.extend(face.iter().flat_map(|index| order(index.to_le_bytes())));
    }
    bytes
}

fn parse(bytes: &[u8]) -> Result<PlyReader> {
    let mut ply = PlyReader::default();
    ply.parse(bytes).map(|()| ply)
}

#[test]
fn ascii_and_binary_files_give_the_same_mesh() {
    for bytes in [ascii().into_bytes(), ascii().replace('\n', "\r\n").into_bytes(), binary(true), binary(false)] {
        let PlyReader { polygons, remarks, .. } = parse(&bytes).expect("a valid file");
        assert_eq!(polygons.positions, POSITIONS);
        assert_eq!(polygons.colors[3], [1.0; 3]);
        assert_eq!(polygons.corners_of(1).iter().map(|corner| corner.vertex).collect::<Vec<_>>(), [0, 2, 3]);
        assert!(remarks.is_empty(), "{remarks:?}");
    }
}

#[test]
fn normals_texture_coordinates_and_unused_properties_are_recognized() {
    let text = "ply\nformat ascii 1.0\ncomment TextureFile wood.png\nelement vertex 3\nproperty double x\n\
        property double y\nproperty double z\nproperty float nx\nproperty float ny\nproperty float nz\n\
        property float s\nproperty float t\nproperty float quality\nelement face 1\n\
        property list uchar uint vertex_index\nproperty list uchar float texcoord\nproperty uchar flags\n\
        element edge 1\nproperty int vertex1\nend_header\n\
        0 0 0 0 0 1 0 0 7\n1 0 0 0 0 1 1 0 7\n0 1 0 0 0 1 0 0.25 7\n3 0 1 2 6 0 0 1 0 0.5 0.75 0\n5\n";
    let ply = parse(text.as_bytes()).expect("a valid file");
    assert_eq!(ply.image.as_deref(), Some("wood.png"));
    assert_eq!(ply.remarks, ["properties that are not used: vertex.quality, face.flags, element edge"]);
    // Texture coordinates of a face have precedence over those of its vertices.
    let corner = ply.polygons.corners_of(0)[2];
    assert_eq!(
        (ply.polygons.uvs[corner.uv as usize], ply.polygons.normals[corner.normal as usize]),
        ([0.5, 0.25], [0.0, 0.0, 1.0])
    );
}

/// meshio writes the points and lines of a mesh of Gmsh as faces with one and two corners.
#[test]
fn points_and_lines_are_a_remark() {
    let text = ascii().replace("element face 2", "element face 4").replace("3 0 1 2\n", "1 0\n2 0 1\n3 0 1 2\n");
    let ply = parse(text.as_bytes()).expect("a valid file");
    assert_eq!(ply.remarks, ["2 faces are points or lines, with fewer than 3 corners: they are not drawn"]);
    assert_eq!(ply.polygons.corners_of(1).iter().map(|corner| corner.vertex).collect::<Vec<_>>(), [0, 2, 3]);
}

#[test]
fn missing_image_is_a_remark_but_an_error_in_strict_mode() {
    let text = ascii()
        .replace("comment made by hand", "comment TextureFile absent.png")
        .replace("uchar red", "float s")
        .replace("uchar green", "float t");
    let folder = tempfile::tempdir().expect("a temporary folder");
    std::fs::write(folder.path().join("a.ply"), text).expect("a writable file");
    let files = AssetDir::unrestricted(folder.path());
    let parts = read(&files, "a.ply", ModelOptions::default()).expect("a mesh without its image");
    assert!(parts.remarks[0].starts_with("TextureFile 'absent.png' does not exist"), "{:?}", parts.remarks);
    let message = read(&files.strict(), "a.ply", ModelOptions::default()).expect_err("strict mode").to_string();
    assert_eq!(message, "file 'a.ply': file 'absent.png': expected an existing file, got none (strict mode)");
}

#[test]
fn truncated_files_are_rejected() {
    for bytes in [ascii().into_bytes(), binary(true)] {
        // The last line break of a text is not needed.
        for length in 0..bytes.len() - 1 {
            assert!(parse(&bytes[..length]).is_err() || bytes[length..] == *b"\n", "{length} of {}", bytes.len());
        }
    }
}

#[test]
fn hostile_headers_and_elements_are_rejected_before_allocation() {
    let replaced = |from: &str, to: &str| ascii().replace(from, to).into_bytes();
    let mut negative = binary(true);
    let last = negative.len() - 4;
    negative[last..].copy_from_slice(&(-1_i32).to_le_bytes());
    let mut long_list = binary(true);
    let list = long_list.len() - 13;
    long_list[list] = 255;
    let text_of = |bytes: Vec<u8>, from: &str, to: &str| {
        let header = bytes.windows(11).position(|window| window == b"end_header\n").expect("a header") + 11;
        let text = String::from_utf8(bytes[..header].to_vec()).expect("a text").replace(from, to);
        [text.as_bytes(), &bytes[header..]].concat()
    };
    for (bytes, start) in [
        (b"ply\n".to_vec(), "header: expected ply, and end_header within 65536 bytes"),
        (replaced("vertex 4", "vertex 4000000000"), "element vertex: expected elements of at least 1 bytes that"),
        (replaced("vertex 4", "vertex 99999999999999999999999"), "header: expected a PLY header"),
        (text_of(binary(true), "vertex 4", "vertex 400"), "element vertex: expected elements of at least 15 bytes"),
        (text_of(binary(true), "face 2", "face 18446744073709551615"), "element face: expected elements of at least"),
        (text_of(binary(true), "property float z", "property float y"), "header: expected a different name"),
        (replaced("property float z\n", "property float w\n"), "element vertex: expected the properties x, y and z"),
        (replaced("element face 2", "element tristrips 2"), "element tristrips: expected faces"),
        (replaced("element face 2", "element polygon 2"), "element face: expected at least one face, got 4 vertices"),
        (
            replaced("3 0 1 2\n3 0 2 3", "1 0\n2 0 2"),
            "element face: expected at least one face, got 2 points and lines",
        ),
        (replaced("int vertex_indices", "float vertex_indices"), "face 0: expected a complete element"),
        (replaced("3 0 2 3", "3 0 2 4"), "face 1: index: expected 0 to 3, got 4"),
        (replaced("3 0 2 3", "4000000000 0 2 3"), "face 1: expected a complete element"),
        (replaced("1 1 0", "1 nan 0"), "vertex 2: expected a complete element"),
        (replaced("1 1 0", "1 1e40 0"), "vertex 2: expected finite numbers, got inf"),
        (negative, "face 1: index: expected 0 to 3, got -1"),
        (long_list, "face 1: expected a complete element"),
    ] {
        let message = parse(&bytes).map(drop).expect_err(start).to_string();
        assert!(message.starts_with(start), "expected {start}, got {message}");
    }
}
