//! The build's own checks: what reflection reads out of SPIR-V, and what it refuses and why.

use crate::emit::{emit, Source};
use crate::reflect::{reflect, Access, Kernel, Scalar, Type};

/// Compiles GLSL with a trivial `main` around `body` and reflects it.
fn kernel(head: &str, body: &str) -> Result<Kernel, String> {
    let folder = tempfile::tempdir().unwrap();
    let (glsl, spv) = (folder.path().join("k.comp"), folder.path().join("k.spv"));
    std::fs::write(&glsl, format!("#version 450\n{head}\nvoid main() {{ {body} }}\n")).unwrap();
    let out = std::process::Command::new("glslangValidator")
        .args(["-V", "--quiet", "--target-env", "vulkan1.1", "-o"])
        .args([&spv, &glsl])
        .output()
        .unwrap();
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stdout));
    let bytes = std::fs::read(spv).unwrap();
    reflect(&bytes.chunks(4).map(|b| u32::from_le_bytes(b.try_into().unwrap())).collect::<Vec<_>>())
}

fn refusal(head: &str) -> String {
    kernel(&format!("layout(local_size_x = 1) in;\n{head}"), "").unwrap_err()
}

fn buffer(block: &str) -> String {
    format!("layout(set = 0, binding = 0, std430) {block};")
}

#[test]
fn interface_is_read_out_of_the_module() {
    let k = kernel(
        "layout(local_size_x = 4, local_size_x_id = 7, local_size_y = 3) in;
         layout(constant_id = 7) const uint WIDTH = 4;
         layout(constant_id = 2) const float GAIN = 1.5;
         layout(set = 0, binding = 1, std430) readonly buffer PairsIn { uvec2 pairs[]; };
         layout(set = 0, binding = 0, std430) writeonly buffer Block { float v[]; } result;
         layout(set = 0, binding = 4, std430) buffer Both { int both[]; };
         layout(push_constant) uniform Push { uint n; float w[2]; } push;
         shared vec4 tile[WIDTH * 2 + 1];
         shared uint flag;",
        "flag = push.n; tile[0] = vec4(GAIN);",
    )
    .unwrap();
    assert_eq!((k.local, k.local_id), ([4, 3, 1], [Some(7), None, None]));
    let specs: Vec<_> = k.specs.iter().map(|s| (s.id, s.name.as_str(), s.ty, s.default)).collect();
    assert_eq!(specs, [(2, "GAIN", Scalar::Float, 1.5f32.to_bits()), (7, "WIDTH", Scalar::Uint, 4)]);
    let buffers: Vec<_> = k.buffers.iter().map(|b| (b.binding, b.name.as_str(), b.access, b.element.clone())).collect();
    assert_eq!(
        buffers,
        [
            (0, "result", Access::Write, Type::Scalar(Scalar::Float)),
            (1, "PairsIn", Access::Read, Type::Vector(Scalar::Uint, 2)),
            (4, "Both", Access::ReadWrite, Type::Scalar(Scalar::Int)),
        ]
    );
    let push = k.push.unwrap();
    assert_eq!((push.size(), push.members[1].offset), (12, 4));
    assert_eq!(k.shared_bytes, 9 * 16 + 4);
    assert_eq!(k.capabilities, [1]);
}

#[test]
fn layouts_without_a_plain_twin_are_refused() {
    let cases = [
        (buffer("buffer B { vec3 v[]; }"), "vec3 is refused"),
        (format!("struct S {{ vec3 a; float b; }}; {}", buffer("buffer B { S s[]; }")), "vec3 is refused"),
        (format!("struct S {{ float a; vec4 b; }}; {}", buffer("buffer B { S s[]; }")), "write the padding out"),
        (format!("struct S {{ vec4 a; float b; }}; {}", buffer("buffer B { S s[]; }")), "write 12 bytes of padding"),
        (buffer("buffer B { uint n; float rest[]; }"), "one runtime array a block"),
        (buffer("buffer B { mat3 m[]; }"), "columns of four floats"),
        (buffer("buffer B { layout(row_major) mat4 m; float x; }"), "row-major"),
        (buffer("buffer B { double d[]; }"), "64-bit numbers are outside the baseline"),
        (buffer("readonly writeonly buffer B { float d[]; }"), "neither read nor written"),
        ("layout(set = 1, binding = 0, std430) buffer B { float d[]; };".into(), "only descriptor set 0"),
        ("layout(push_constant) uniform P { float a[33]; };".into(), "132 bytes"),
        ("layout(set = 0, binding = 0) uniform U { float a; };".into(), "uniform blocks are not used"),
        ("layout(constant_id = 0) const double D = 1.0;".into(), "only bool and 32-bit"),
    ];
    for (head, why) in cases {
        let said = refusal(&head);
        assert!(said.contains(why), "{head}: {said}");
    }
    let nine: String = (0..9).map(|i| format!("layout(binding = {i}) buffer B{i} {{ float b{i}[]; }};\n")).collect();
    assert!(refusal(&nine).contains("9 storage buffers"));
    let same: String = (0..2).map(|i| format!("layout(binding = 3) buffer B{i} {{ float b{i}[]; }};\n")).collect();
    assert!(refusal(&same).contains("share binding 3"));
}

fn source(stem: &str, heads: &[(&str, &str)]) -> Source {
    let one = |&(define, head): &(&str, &str)| {
        let k = kernel(&format!("layout(local_size_x = 1) in;\n{head}"), "").unwrap();
        (define.to_string(), k, format!("{stem}.spv"))
    };
    Source { stem: stem.into(), variants: heads.iter().map(one).collect() }
}

#[test]
fn one_struct_name_has_one_layout() {
    let with = |fields: &str| format!("struct S {{ {fields} }}; {}", buffer("buffer B { S s[]; }"));
    let (a, b) = (with("float x; float y;"), with("float x; uint y;"));
    let sources = |second: &str| [source("first", &[("", &a)]), source("second", &[("", second)])];
    let said = emit(&sources(&b)).unwrap_err();
    assert!(said[0].contains("struct S") && said[0].contains("first") && said[0].contains("second"), "{said:?}");
    let text = emit(&sources(&a)).unwrap();
    assert_eq!(text.matches("pub struct S {").count(), 1);
}

#[test]
fn variants_share_the_interface_of_the_baseline() {
    let (a, b) = (buffer("readonly buffer B { float x[]; }"), buffer("buffer B { float x[]; }"));
    let said = emit(&[source("k", &[("", &a), ("FAST", &b)])]).unwrap_err();
    assert!(said[0].contains("variant `FAST`"), "{said:?}");
    assert!(emit(&[source("k", &[("", &a), ("FAST", &a)])]).is_ok());
}

#[test]
fn a_variant_may_read_as_texels_what_the_baseline_reads_as_a_buffer() {
    let texels = |kind: &str| format!("layout(set = 0, binding = 0) uniform {kind} B;");
    let of = |baseline: &str, kind: &str| emit(&[source("k", &[("", &buffer(baseline)), ("CPU", &texels(kind))])]);
    // The numbers of VkFormat's R32_SFLOAT, R32G32_UINT and R32G32B32A32_SFLOAT.
    for (baseline, kind, format) in [
        ("readonly buffer B { float x[]; }", "samplerBuffer", 100),
        ("readonly buffer B { uvec2 x[]; }", "usamplerBuffer", 101),
        ("readonly buffer B { vec4 x[]; }", "samplerBuffer", 109),
    ] {
        let text = of(baseline, kind).unwrap();
        assert!(text.contains(&format!("texels: [{format}, 0, 0, 0, 0, 0, 0, 0]")), "{text}");
    }
    for (baseline, kind) in [
        ("readonly buffer B { float x[]; }", "usamplerBuffer"),
        ("buffer B { float x[]; }", "samplerBuffer"),
        ("readonly buffer C { float x[]; }", "samplerBuffer"),
    ] {
        assert!(of(baseline, kind).unwrap_err()[0].contains("variant `CPU`"), "{baseline} {kind}");
    }
    assert!(emit(&[source("k", &[("", &texels("samplerBuffer"))])]).unwrap_err()[0].contains("in the baseline"));
}

#[test]
fn garbage_is_no_module() {
    assert!(reflect(&[]).is_err());
    assert!(reflect(&[0; 8]).is_err());
    assert!(reflect(&[0x0723_0203, 0x0001_0300, 0, 10, 0, 0x0009_0005]).is_err());
}
