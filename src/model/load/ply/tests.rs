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
        assert_eq!(polygons.positions, POSITIONS.map(|position| position.map(f64::from)));
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
    assert_eq!(ply.polygons.materials, ["wood.png"]);
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
    let remarks = ply.polygons.corrections.remarks(false).expect("remarks");
    assert_eq!(remarks, ["faces: expected at least 3 corners, got 2 points and lines: they are not drawn"]);
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

/// Line ends, blanks, comments and elements over several lines, as other programs write them.
#[test]
fn layouts_of_texts_give_the_same_mesh() {
    let expected = parse(ascii().as_bytes()).expect("a valid file").polygons;
    let with_tabs = ascii().replace("property float ", "property \t float\t").replace("element ", "  element   ");
    let latin1 = [b"ply\ncomment \xe9t\xe9\n", &ascii().as_bytes()[4..]].concat();
    let multiline = ascii().replace("1 1 0 ", "1 1\n0\n").replace("3 0 2 3", "3\n0 2\n3\n");
    for bytes in [
        ascii().replace('\n', "\r").into_bytes(),
        ascii().replace('\n', " \r\n").into_bytes(),
        ascii().replace(' ', "\t").replace("format\tascii\t", "format ascii ").into_bytes(),
        with_tabs.into_bytes(),
        latin1,
        multiline.into_bytes(),
        format!("\u{feff}{}", ascii()).into_bytes(),
    ] {
        let ply = parse(&bytes).expect("a valid file");
        assert_eq!((&ply.polygons.positions, &ply.polygons.colors), (&expected.positions, &expected.colors));
        assert_eq!(ply.polygons.corners_of(1), expected.corners_of(1));
        assert!(ply.remarks.is_empty(), "{:?}", ply.remarks);
    }
    // The first coordinate of a binary file begins with a line feed.
    let header = |line_end: &str| {
        let bytes = binary(true);
        let end = bytes.windows(11).position(|window| window == b"end_header\n").expect("a header") + 11;
        let text = String::from_utf8(bytes[..end].to_vec()).expect("a text").replace('\n', line_end);
        [text.as_bytes(), b"\n", &bytes[end + 1..]].concat()
    };
    for line_end in ["\r", "\r\n", "\n"] {
        let position = parse(&header(line_end)).expect("a valid file").polygons.positions[0];
        assert_eq!(position, [f64::from(f32::from_bits(10)), 0.0, 0.0], "{line_end:?}");
    }
}

#[test]
fn values_without_effect_are_remarks() {
    let normals =
        ascii().replace("uchar red", "float nx").replace("uchar green", "float ny").replace("uchar blue", "float nz");
    let unused_vertex = ascii().replace("vertex 4", "vertex 5").replace("\n3 0 1 2", "\nnan 0 0 0 0 0\n3 0 1 2");
    let colors = ascii().replace("uchar", "float").replace("list float", "list uchar");
    for (text, start) in [
        (normals.replace("0 0 0 255 0 0", "0 0 0 nan 0 0"), "normal: expected finite numbers, got [NaN, 0.0, 0.0]"),
        (unused_vertex, "position: expected finite numbers, got [NaN, 0.0, 0.0] (vertex 4)"),
        (colors.clone(), "colors of vertices are divided by 255"),
        (colors.replace("255", "1.0001"), "color of a vertex: expected 0 to 1, got [1.0001, 0.0, 0.0] (vertex 0)"),
    ] {
        let corrections = parse(text.as_bytes()).expect("a valid file").polygons.corrections;
        let remarks = corrections.remarks(false).expect("remarks");
        assert!(remarks[0].starts_with(start) && remarks.len() == 1, "expected {start}, got {remarks:?}");
    }
}

/// Faces choose their image by `texnumber`.
#[test]
fn faces_with_several_images_have_a_material_each() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    for (name, texel) in [("red.png", [255, 0, 0, 255]), ("blue.png", [0, 0, 255, 255])] {
        let image = image::RgbaImage::from_pixel(1, 1, image::Rgba(texel));
        image.save(folder.path().join(name)).expect("a writable file");
    }
    let text = |second: i32| {
        format!(
            "ply\nformat ascii 1.0\ncomment TEXTUREFILE red.png\ncomment texturefile blue.png\nelement vertex 3\n\
             property float x\nproperty float y\nproperty float z\nelement face 2\n\
             property list uchar int vertex_indices\nproperty list uchar float texcoord\nproperty int texnumber\n\
             end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 6 0 0 1 0 1 1 {second}\n3 0 1 2 6 0 0 1 0 1 1 0\n"
        )
    };
    let read_text = |text: String| {
        std::fs::write(folder.path().join("a.ply"), text).expect("a writable file");
        read(&AssetDir::unrestricted(folder.path()), "a.ply", ModelOptions::default()).expect("a valid file")
    };
    let parts = read_text(text(1));
    let ranges: Vec<_> = parts.domains[0].material_ranges.iter().map(|range| range.material).collect();
    assert_eq!((ranges, parts.textures[1].rgba()), (vec![0, 1], &[0, 0, 255, 255][..]));
    assert_eq!((parts.materials[0].color_texture, parts.materials[1].color_texture), (Some(0), Some(1)));
    assert!(parts.remarks.is_empty(), "{:?}", parts.remarks);
    let remarks = read_text(text(7)).remarks;
    assert_eq!(remarks, ["texnumber: expected 0 to 1, got 7 (face 0): the first image is used"]);
}

/// A line before the faces has a color, too.
#[test]
fn colors_of_faces_are_materials_unless_vertices_have_colors() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let read_with = |vertex_properties: &str, channel: &str, colors: [&str; 3], vertex_end: &str| {
        let text = format!(
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
             {vertex_properties}element face 3\nproperty list uchar int vertex_indices\nproperty {channel} red\n\
             property {channel} green\nproperty {channel} blue\nend_header\n\
             0 0 0{vertex_end}\n1 0 0{vertex_end}\n0 1 0{vertex_end}\n2 0 1 {}\n3 0 1 2 {}\n3 2 1 0 {}\n",
            colors[0], colors[1], colors[2]
        );
        std::fs::write(folder.path().join("a.ply"), text).expect("a writable file");
        read(&AssetDir::unrestricted(folder.path()), "a.ply", ModelOptions::default()).expect("a valid file")
    };
    for (channel, colors) in [
        ("uchar", ["9 9 9", "255 0 0", "0 0 255"]),
        ("float", ["0.5 0 0", "1 0 0", "0 0 1"]),
        ("float", ["128 64 32", "255 0 0", "0 0 255"]),
    ] {
        let parts = read_with("", channel, colors, "");
        let diffuse: Vec<_> = parts.materials.iter().map(|material| material.diffuse).collect();
        assert_eq!(diffuse, [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]);
        assert_eq!(parts.domains[0].material_ranges.len(), 2);
        assert!(!parts.remarks.iter().any(|remark| remark.contains("face.red")), "{:?}", parts.remarks);
        let is_divided = parts.remarks.iter().any(|remark| remark.starts_with("colors of faces are divided by 255"));
        assert_eq!(is_divided, channel == "float" && colors[1] == "255 0 0", "{:?}", parts.remarks);
    }
    let properties = "property uchar red\nproperty uchar green\nproperty uchar blue\n";
    let parts = read_with(properties, "uchar", ["9 9 9", "255 0 0", "0 0 255"], " 0 255 0");
    assert_eq!((parts.materials.len(), parts.materials[0].diffuse), (1, [0.0, 1.0, 0.0]));
    let white = read_with(properties, "uchar", ["9 9 9", "255 0 0", "0 0 255"], " 255 255 255");
    assert_eq!((white.materials.len(), white.materials[0].diffuse), (2, [1.0, 0.0, 0.0]));
    let remark = "colors of faces are not used, because the vertices have colors";
    assert!(parts.remarks.iter().any(|given| given == remark), "{:?}", parts.remarks);
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
fn magic_number_has_any_letter_case() {
    let upper_case = ascii().replacen("ply", "PLY", 1);
    let ply = parse(upper_case.as_bytes()).expect("a valid file");
    assert_eq!(ply.polygons.positions, POSITIONS.map(|position| position.map(f64::from)));
    assert!(parse(ascii().replacen("ply", "plx", 1).as_bytes()).is_err(), "control");
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
        (replaced("element face", "Created by me\nelement face"), "header: line "),
        (text_of(binary(true), "vertex 4", "vertex 400"), "element vertex: expected elements of at least 15 bytes"),
        (text_of(binary(true), "face 2", "face 18446744073709551615"), "element face: expected elements of at least"),
        (text_of(binary(true), "property float z", "property float y"), "header: expected a different name"),
        (replaced("property float z\n", "property float w\n"), "element vertex: expected the properties x, y and z"),
        (replaced("element face 2", "element tristrips 2"), "element tristrips: expected faces"),
        (replaced("element face 2", "element polygon 2"), "element face: expected at least one face, got 4 vertices"),
        (replaced("3 0 1 2\n3 0 2 3", "1 0\n2 0 2"), "faces: expected at least one face, got 2 points and lines"),
        (replaced("3 0 2 3", "3 0 2 2.5"), "face 1: index: expected 0 to 3, got 2.5"),
        (replaced("3 0 2 3", "3 0 2 4"), "face 1: index: expected 0 to 3, got 4"),
        (
            replaced("3 0 2 3", "4000000000 0 2 3"),
            "face 1: property vertex_indices: list: expected a length of at most",
        ),
        (
            replaced("3 0 2 3", "3 0 2"),
            "face 1: property vertex_indices: number: expected a number, got the end of the file",
        ),
        (replaced("3 0 1 2", "3 0 1 2 7"), "face 0: expected a line end after the declared properties, got 7"),
        (replaced("1 1 0", "1 nan 0"), "face 0: position of vertex 2: expected finite numbers, got [1.0, NaN, 0.0]"),
        (replaced("1 1 0", "1 1e40 0"), "face 0: position of vertex 2: expected finite numbers, got [1.0, inf, 0.0]"),
        (replaced("1 1 0", "1 x 0"), "vertex 2: property y: number: expected a number, got x"),
        (negative, "face 1: index: expected 0 to 3, got -1"),
        (long_list, "face 1: expected a complete element"),
    ] {
        let message = parse(&bytes).map(drop).expect_err(start).to_string();
        assert!(message.starts_with(start), "expected {start}, got {message}");
    }
}
