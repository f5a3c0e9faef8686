//! Seeds of the targets of model files: small valid files of every kind, from which the fuzzer starts.

/// The bytes of [`gltf_buffer`] as a property of a glTF buffer.
const GLTF_URI: &str =
    r#", "uri": "data:application/octet-stream;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAAAAABAAIAAAA=""#;

pub(crate) fn seeds(target: &str) -> Vec<Vec<u8>> {
    match target {
        "glb" => vec![glb(&gltf_json(""), &gltf_buffer())],
        "gltf" => vec![gltf_json(GLTF_URI)],
        "image" => vec![super::target::PIXEL.to_vec(), jpeg()],
        "manifest" => texts(&[
            "name = \"s\"\nup = \"z\"\nunit = 0.5\nmodel = \"m.obj\"\nmodes = \"\"\n",
            "shadows = true\nlook.preset = \"best\"\nlook.sunlight = [1.0, 0.9, 0.8]\nlook.shadow = { method = \
             \"variance\", size = 2048, blur = 2.0 }\nlook.bloom = { threshold = 1.0, strength = 0.5 }\ndeform.normals = \"exact\"\n\
             [material.\"*\"]\nshininess = 20\n[[domain]]\nname = \"a\"\nmodel = \"m.obj\"\n[[domain]]\nname = \"b\"\n\
             model = \"m.obj\"\nparent = \"a\"\nfollows = \"\"\nframe = { translation = \
             [0, 1, 0], axis = [0, 0, 1], degrees = 30, scale = 0.5 }\nmaterial = { diffuse = [1, 0, 0] }\n",
        ]),
        "mtl" => texts(&[
            "newmtl a\nKa 0.1 0.1 0.1\nKd 1 0.5 0\nKs 1 1 1\nNs 20\nd 0.5\nillum 2\nmap_Kd t.png\nmap_d t.png\n\
             norm t.png\nnewmtl b\nTr 0.2\nKe 1 1 1\n",
        ]),
        "npy" => vec![npy("<f4", "(12, 1)", &f32s(12)), npy("<f8", "(4, 3, 1)", &[0; 96])],
        "npz" => vec![npz(&[
            ("vertices", npy("<f4", "(3, 3)", &f32s(9))),
            ("faces", npy("<i4", "(1, 3)", &[0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0])),
            ("U", npy("<f4", "(9, 1)", &f32s(9))),
            ("eigenvalues", npy("<f8", "(1,)", &2.0_f64.to_le_bytes())),
            ("corner_normals", npy("<f4", "(1, 3, 3)", &f32s(9))),
            ("face_materials", npy("|u1", "(1,)", &[1])),
            ("material_colors", npy("|u1", "(2, 3)", &[0, 0, 1, 1, 1, 0])),
            ("notes", npy("|u1", "(10,)", b"{\"a\": \"b\"}")),
        ])],
        "obj" => texts(&[
            "mtllib m.mtl\no a\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvn 0 0 1\ng p\ns 1\nusemtl a\n\
             f 1/1/1 2/2/1 3/2/1\nf -4/1/1 -2/2/1 -1/1/1\n",
            "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 1 0.5 0\nv 0 2 0\nv 0 1 0\nf 1 2 3 4 5 6\n",
        ]),
        "plant" => texts(&[
            "{\"objects\":{\"1\":\"internode\",\"2\":\"leaf\",\"3\":\"petiole\"},\"shoots\":[{\"id\":0,\"parent\":-1,\
             \"vertices\":[[0,0,0],[0,0,1]]}],\"leaves\":[{\"object_id\":2,\"shoot\":0,\"node\":0,\"petiole\":0,\
             \"base\":[0,0,1],\"petiole_vertices\":[[0,0,1],[0,1,1]]}]}\x001\n2\n",
        ]),
        "ply" => {
            texts(&["ply\nformat ascii 1.0\ncomment triangle\nelement vertex 3\nproperty float x\nproperty float y\n\
             property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n\
             property list uchar int vertex_indices\nend_header\n0 0 0 255 0 0\n1 0 0 0 255 0\n0 1 0 0 0 255\n\
             3 0 1 2\n"])
            .into_iter()
            .chain([binary_ply()])
            .collect()
        }
        "safetensors" => vec![safetensors()],
        "skeleton" => texts(&[
            "{\"shoots\":[{\"id\":0,\"parent\":-1,\"vertices\":[[0,0,0],[0.1,0,0.5],[0,0,1]],\"radii\":[0.02,0.01,0.01]},\
             {\"id\":1,\"parent\":0,\"vertices\":[[0,0,1],[0.2,0,1]],\"radii\":[0.003,0.002],\"modes\":4}],\
             \"leaves\":[{\"object_id\":2,\"shoot\":1,\"node\":0,\"petiole\":0,\"base\":[0.2,0.05,1],\
             \"petiole_vertices\":[[0.2,0,1],[0.2,0.05,1]],\"tip\":[0.2,0.1,1],\"width\":0.03,\"modes\":0},\
             {\"object_id\":3,\"shoot\":1,\"node\":0,\"petiole\":0,\"base\":[0.2,0.05,1]}]}",
            "{\"shoots\":[{\"id\":0,\"parent\":-1,\"vertices\":[[0,0,0],[0,0,1]],\"radii\":[0.01,0]}],\"leaves\":[]}",
        ]),
        "sofa" => texts(&["12 1\n0\n0\n1\n0\n0\n1\n0\n0\n1\n0\n0\n1\n", "12. 0.\n"]),
        "stl" => [
            texts(&[
                "solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n\
             endsolid s\n",
            ]),
            vec![binary_stl()],
        ]
        .concat(),
        "vega" => vec![[&12_i32.to_le_bytes()[..], &1_i32.to_le_bytes(), &f32s(12)].concat()],
        "vega_config" => texts(&["*baseFrequency\n0.25\n*dampingMassCoef\n0\n# note\n*dampingStiffnessCoef\n1e-3\n"]),
        _ => Vec::new(),
    }
}

fn texts(texts: &[&str]) -> Vec<Vec<u8>> {
    texts.iter().map(|text| text.as_bytes().to_vec()).collect()
}

/// Ascending numbers, little-endian.
fn f32s(count: u8) -> Vec<u8> {
    (0..count).flat_map(|number| f32::from(number).to_le_bytes()).collect()
}

/// A triangle with a morph target. `uri` is the rest of the buffer's object.
fn gltf_json(uri: &str) -> Vec<u8> {
    format!(
        r#"{{"asset": {{"version": "2.0"}}, "scene": 0, "scenes": [{{"nodes": [0]}}],
        "nodes": [{{"mesh": 0, "translation": [1, 0, 0], "children": [1]}}, {{"mesh": 0, "rotation": [0, 0, 0, 1]}}],
        "meshes": [{{"weights": [0.5], "primitives": [
            {{"attributes": {{"POSITION": 0}}, "indices": 1, "material": 0, "targets": [{{"POSITION": 0}}]}}]}}],
        "materials": [{{"pbrMetallicRoughness": {{"baseColorFactor": [1, 0, 0, 1], "metallicFactor": 0.5}},
            "alphaMode": "MASK", "alphaCutoff": 0.5}}],
        "buffers": [{{"byteLength": 44{uri}}}],
        "bufferViews": [{{"buffer": 0, "byteLength": 36}}, {{"buffer": 0, "byteOffset": 36, "byteLength": 6}}],
        "accessors": [
            {{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]}},
            {{"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"}}]}}"#
    )
    .into_bytes()
}

fn gltf_buffer() -> Vec<u8> {
    let positions: Vec<u8> =
        [0.0_f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0].iter().flat_map(|x| x.to_le_bytes()).collect();
    [&positions[..], &[0, 0, 1, 0, 2, 0, 0, 0]].concat()
}

fn glb(json: &[u8], buffer: &[u8]) -> Vec<u8> {
    let json = [json, &b"   "[..(4 - json.len() % 4) % 4]].concat();
    let mut file = b"glTF\x02\0\0\0".to_vec();
    file.extend((12 + 16 + json.len() as u32 + buffer.len() as u32).to_le_bytes());
    for (kind, content) in [(b"JSON", &json[..]), (b"BIN\0", buffer)] {
        file.extend((content.len() as u32).to_le_bytes());
        file.extend(kind);
        file.extend(content);
    }
    file
}

/// A gray image of 8 x 8 pixels. Its only Huffman codes are a difference of zero and the end of the block.
fn jpeg() -> Vec<u8> {
    let mut file = vec![0xff, 0xd8, 0xff, 0xdb, 0, 67, 0];
    file.extend([1; 64]);
    file.extend([0xff, 0xc0, 0, 11, 8, 0, 8, 0, 8, 1, 1, 0x11, 0]);
    for class in [0x00, 0x10] {
        file.extend([0xff, 0xc4, 0, 20, class, 1]);
        file.extend([0; 16]);
    }
    file.extend([0xff, 0xda, 0, 8, 1, 1, 0, 0, 63, 0, 0x3f, 0xff, 0xd9]);
    file
}

fn npy(kind: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}");
    [b"\x93NUMPY\x01\x00\x76\x00", format!("{header:<117}\n").as_bytes(), data].concat()
}

/// A zip archive whose files are not compressed.
fn npz(arrays: &[(&str, Vec<u8>)]) -> Vec<u8> {
    let (mut archive, mut directory) = (Vec::new(), Vec::new());
    for (array, content) in arrays {
        let name = format!("{array}.npy");
        let offset = archive.len() as u32;
        let size = (content.len() as u32).to_le_bytes();
        // Version, flags, method, time and date, then checksum, sizes and the lengths of the name and of extra fields.
        let mut head = vec![20, 0, 0, 0, 0, 0, 0, 0, 0x21, 0];
        head.extend(crc32fast::hash(content).to_le_bytes());
        head.extend([size, size].concat());
        head.extend([name.len() as u8, 0, 0, 0]);
        archive.extend([&b"PK\x03\x04"[..], &head, name.as_bytes(), content].concat());
        // Also a comment, the disk, attributes and the offset.
        directory.extend([&b"PK\x01\x02\x14\0"[..], &head, &[0; 10], &offset.to_le_bytes(), name.as_bytes()].concat());
    }
    let (count, offset) = (arrays.len() as u8, archive.len() as u32);
    archive.extend(&directory);
    archive.extend([&b"PK\x05\x06\0\0\0\0"[..], &[count, 0, count, 0]].concat());
    archive.extend((directory.len() as u32).to_le_bytes());
    archive.extend([&offset.to_le_bytes()[..], &[0; 2]].concat());
    archive
}

fn binary_ply() -> Vec<u8> {
    let head = b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
                 property float z\nelement face 1\nproperty list uchar uint vertex_indices\nend_header\n";
    [&head[..], &f32s(9), &[3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]].concat()
}

fn binary_stl() -> Vec<u8> {
    let triangle = [0.0_f32, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    let triangle: Vec<u8> = triangle.iter().flat_map(|x| x.to_le_bytes()).collect();
    [&[b' '; 80][..], &1_u32.to_le_bytes(), &triangle, &[0; 2]].concat()
}

fn safetensors() -> Vec<u8> {
    let header = br#"{"U":{"dtype":"F32","shape":[12,1],"data_offsets":[0,48]},
        "eigenvalues":{"dtype":"F64","shape":[1],"data_offsets":[48,56]}}"#;
    [&(header.len() as u64).to_le_bytes()[..], header, &f32s(12), &2.0_f64.to_le_bytes()].concat()
}
