//! Writes reflected kernels as Rust: one module a kernel, shared structs once in `types`.
//!
//! What is written is read by people (`target/**/out/kernels.rs`), so it is plain: structs, constants
//! and one `impl KernelDef` a kernel.

use crate::reflect::{Access, Buffer, Kernel, Scalar, Struct, Type, BUFFERS_MAX};
use std::collections::BTreeMap;
use std::fmt::Write;

/// A kernel and its faster variants, compiled from one file.
pub struct Source {
    pub stem: String,
    /// Define, reflected module, and SPIR-V file; the baseline first, with an empty define.
    pub variants: Vec<(String, Kernel, String)>,
}

/// The Rust text of all kernels, or every disagreement among them.
pub fn emit(sources: &[Source]) -> Result<String, Vec<String>> {
    let mut errors = Vec::new();
    let mut types: BTreeMap<String, (Struct, String)> = BTreeMap::new();
    for source in sources {
        let base = &source.variants[0].1;
        if let Some(buffer) = base.buffers.iter().find(|b| b.texels) {
            errors.push(format!("{}: `{}` is a buffer of texels in the baseline", source.stem, buffer.name));
        }
        for (define, other, _) in &source.variants[1..] {
            let buffers = base.buffers.len() == other.buffers.len()
                && base.buffers.iter().zip(&other.buffers).all(|(base, other)| texel_format(base, other).is_some());
            if !buffers || (&base.push, &base.specs, base.local) != (&other.push, &other.specs, other.local) {
                errors.push(format!("{}: variant `{define}` has another interface than the baseline", source.stem));
            }
        }
        let mut collect = |ty: &Type| {
            if let Err(e) = collect_structs(ty, &source.stem, &mut types) {
                errors.push(e);
            }
        };
        base.buffers.iter().for_each(|b| collect(&b.element));
        base.push.iter().flat_map(|p| &p.members).for_each(|m| collect(&m.ty));
    }
    if !errors.is_empty() {
        return Err(errors);
    }
    let mut out = String::new();
    text(&mut out, sources, &types).map_err(|e| vec![e.to_string()])?;
    Ok(out)
}

/// VkFormat of the texels that a variant reads a buffer of the baseline as: zero where it is the same storage buffer. `None` where
/// it is neither.
fn texel_format(base: &Buffer, variant: &Buffer) -> Option<i32> {
    if base == variant && !base.texels {
        return Some(0);
    }
    let names = field(&base.name) == field(&variant.name) && base.binding == variant.binding;
    if !names || !variant.texels || base.texels || base.access != Access::Read {
        return None;
    }
    let Type::Scalar(scalar) = variant.element else { return None };
    // Elements of four words and more are texels of four components.
    match (scalar, base.element.size()) {
        _ if !is_all(&base.element, scalar) => None,
        (Scalar::Uint, 4) => Some(98),
        (Scalar::Float, 4) => Some(100),
        (Scalar::Uint, 8) => Some(101),
        (Scalar::Float, 8) => Some(103),
        (Scalar::Float, bytes) if bytes % 16 == 0 => Some(109),
        _ => None,
    }
}

/// Whether a type has no other scalars than this.
fn is_all(ty: &Type, scalar: Scalar) -> bool {
    match ty {
        Type::Scalar(s) | Type::Vector(s, _) => *s == scalar,
        Type::Matrix(_) => scalar == Scalar::Float,
        Type::Array { of, .. } | Type::Runtime { of, .. } => is_all(of, scalar),
        Type::Struct(s) => s.members.iter().all(|m| is_all(&m.ty, scalar)),
    }
}

fn text(out: &mut String, sources: &[Source], types: &BTreeMap<String, (Struct, String)>) -> std::fmt::Result {
    writeln!(out, "/// Structs of buffers and push constants, shared by every kernel that names them.")?;
    writeln!(out, "pub mod types {{")?;
    for (s, _) in types.values() {
        structure(out, s, &s.name, "super::types::")?;
    }
    writeln!(out, "}}")?;
    for source in sources {
        kernel(out, source)?;
    }
    writeln!(out, "/// What every module declares, for the test of the baseline.")?;
    writeln!(out, "pub const ALL: &[crate::gpu::Reflected] = &[")?;
    for source in sources {
        for (define, k, _) in &source.variants {
            writeln!(
                out,
                "    crate::gpu::Reflected {{ name: {:?}, baseline: {}, local: {:?}, shared_bytes: {}, buffers: {}, push_bytes: {}, capabilities: &{:?} }},",
                variant_name(&source.stem, define),
                define.is_empty(),
                k.local,
                k.shared_bytes,
                k.buffers.len(),
                k.push.as_ref().map_or(0, Struct::size),
                k.capabilities,
            )?;
        }
    }
    writeln!(out, "];")
}

fn kernel(out: &mut String, source: &Source) -> std::fmt::Result {
    let k = &source.variants[0].1;
    let t = "super::types::";
    writeln!(out, "pub mod {} {{", source.stem)?;
    writeln!(
        out,
        "use crate::gpu::{{Access, KernelDef, Range, Read, ReadWrite, Variant, Write, BUFFERS_MAX, SPECS_MAX}};"
    )?;
    writeln!(out, "pub const NAME: &str = {:?};", source.stem)?;
    writeln!(out, "pub const LOCAL: [u32; 3] = {:?};", k.local)?;
    writeln!(out, "pub const SPIRV: &[u8] = include_bytes!({:?});", source.variants[0].2)?;
    match &k.push {
        Some(push) => structure(out, push, "Push", t)?,
        None => writeln!(out, "pub type Push = ();")?,
    }
    spec(out, k)?;
    writeln!(out, "#[derive(Clone, Copy)]\npub struct Bind {{")?;
    for b in &k.buffers {
        let access = match b.access {
            Access::Read => "Read",
            Access::Write => "Write",
            Access::ReadWrite => "ReadWrite",
        };
        writeln!(out, "    pub {}: {access}<{}>,", field(&b.name), rust(&b.element, t))?;
    }
    writeln!(out, "}}\n/// Names this kernel to `Gpu::kernel`.\n#[derive(Clone, Copy, Debug)]\npub struct K;")?;
    writeln!(out, "impl KernelDef for K {{")?;
    writeln!(out, "    type Push = Push;\n    type Spec = Spec;\n    type Bind = Bind;")?;
    writeln!(out, "    const NAME: &'static str = NAME;")?;
    let bindings: Vec<String> = k.buffers.iter().map(|b| format!("({}, Access::{:?})", b.binding, b.access)).collect();
    writeln!(out, "    const BINDINGS: &'static [(u32, Access)] = &[{}];", bindings.join(", "))?;
    let ids: Vec<u32> = k.specs.iter().map(|s| s.id).collect();
    writeln!(out, "    const SPEC_IDS: &'static [u32] = &{ids:?};")?;
    writeln!(out, "    const VARIANTS: &'static [Variant] = &[")?;
    for (define, v, file) in &source.variants {
        let mut texels = [0; BUFFERS_MAX];
        for ((format, base), buffer) in texels.iter_mut().zip(&k.buffers).zip(&v.buffers) {
            *format = texel_format(base, buffer).unwrap_or(0);
        }
        writeln!(
            out,
            "        Variant {{ define: {define:?}, name: {:?}, spirv: include_bytes!({file:?}), shared_bytes: {}, capabilities: &{:?}, texels: {texels:?} }},",
            variant_name(&source.stem, define),
            v.shared_bytes,
            v.capabilities
        )?;
    }
    writeln!(out, "    ];")?;
    let local: Vec<String> = (0..3)
        .map(|axis| match k.local_id[axis].and_then(|id| k.specs.iter().find(|s| s.id == id)) {
            Some(s) => format!("spec.{} as u32", field(&s.name)),
            None => k.local[axis].to_string(),
        })
        .collect();
    writeln!(
        out,
        "    #[allow(unused_variables)]\n    fn local(spec: &Spec) -> [u32; 3] {{ [{}] }}",
        local.join(", ")
    )?;
    writeln!(out, "    #[allow(unused_variables)]\n    fn spec_words(spec: &Spec) -> [u32; SPECS_MAX] {{")?;
    writeln!(out, "        let mut words = [0; SPECS_MAX];")?;
    for (i, s) in k.specs.iter().enumerate() {
        let value = match s.ty {
            Scalar::Float => format!("spec.{}.to_bits()", field(&s.name)),
            _ => format!("spec.{} as u32", field(&s.name)),
        };
        writeln!(out, "        words[{i}] = {value};")?;
    }
    writeln!(out, "        words\n    }}")?;
    writeln!(out, "    #[allow(unused_variables)]\n    fn ranges(bind: &Bind) -> [Range; BUFFERS_MAX] {{")?;
    writeln!(out, "        let mut ranges = [Range::default(); BUFFERS_MAX];")?;
    for (i, b) in k.buffers.iter().enumerate() {
        writeln!(out, "        ranges[{i}] = bind.{}.range();", field(&b.name))?;
    }
    writeln!(out, "        ranges\n    }}\n}}\n}}")
}

fn spec(out: &mut String, k: &Kernel) -> std::fmt::Result {
    writeln!(out, "/// Specialisation constants; the defaults are the shader's.")?;
    writeln!(out, "#[derive(Clone, Copy, Debug, PartialEq)]\npub struct Spec {{")?;
    for s in &k.specs {
        writeln!(out, "    pub {}: {},", field(&s.name), scalar(s.ty))?;
    }
    writeln!(out, "}}\nimpl Default for Spec {{\n    fn default() -> Spec {{ Spec {{")?;
    for s in &k.specs {
        let value = match s.ty {
            Scalar::Float => format!("f32::from_bits({})", s.default),
            Scalar::Int => (s.default as i32).to_string(),
            Scalar::Uint => s.default.to_string(),
            Scalar::Bool => (s.default != 0).to_string(),
        };
        writeln!(out, "        {}: {value},", field(&s.name))?;
    }
    writeln!(out, "    }} }}\n}}")
}

fn structure(out: &mut String, s: &Struct, name: &str, types: &str) -> std::fmt::Result {
    writeln!(out, "#[repr(C)]\n#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]")?;
    writeln!(out, "pub struct {name} {{")?;
    for m in &s.members {
        writeln!(out, "    pub {}: {},", field(&m.name), rust(&m.ty, types))?;
    }
    writeln!(out, "}}\nimpl Default for {name} {{ fn default() -> Self {{ bytemuck::Zeroable::zeroed() }} }}")?;
    writeln!(out, "const _: () = assert!(core::mem::size_of::<{name}>() == {});", s.size())?;
    for m in &s.members {
        writeln!(out, "const _: () = assert!(core::mem::offset_of!({name}, {}) == {});", field(&m.name), m.offset)?;
    }
    Ok(())
}

/// Adds the structs `ty` is made of; the same name with another layout is an error.
fn collect_structs(ty: &Type, stem: &str, types: &mut BTreeMap<String, (Struct, String)>) -> Result<(), String> {
    match ty {
        Type::Array { of, .. } | Type::Runtime { of, .. } => collect_structs(of, stem, types),
        Type::Struct(s) => {
            for m in &s.members {
                collect_structs(&m.ty, stem, types)?;
            }
            match types.get(&s.name) {
                Some((old, first)) if old != s => {
                    Err(format!("struct {} has one layout in {first} and another in {stem}", s.name))
                }
                Some(_) => Ok(()),
                None => {
                    types.insert(s.name.clone(), (s.clone(), stem.to_string()));
                    Ok(())
                }
            }
        }
        _ => Ok(()),
    }
}

fn rust(ty: &Type, types: &str) -> String {
    match ty {
        Type::Scalar(s) => scalar(*s).to_string(),
        Type::Vector(s, n) => format!("[{}; {n}]", scalar(*s)),
        Type::Matrix(columns) => format!("[[f32; 4]; {columns}]"),
        Type::Array { of, len, .. } => format!("[{}; {len}]", rust(of, types)),
        Type::Runtime { of, .. } => rust(of, types),
        Type::Struct(s) => format!("{types}{}", s.name),
    }
}

fn scalar(s: Scalar) -> &'static str {
    match s {
        Scalar::Float => "f32",
        Scalar::Int => "i32",
        Scalar::Uint => "u32",
        Scalar::Bool => "bool",
    }
}

pub fn variant_name(stem: &str, define: &str) -> String {
    match define {
        "" => stem.to_string(),
        _ => format!("{stem}_{}", define.to_lowercase()),
    }
}

/// `TileCounts`, `tileCounts` and `TILE_COUNTS` all become `tile_counts`.
fn field(name: &str) -> String {
    let mut out = String::new();
    let mut lower_before = false;
    for c in name.chars() {
        if c.is_ascii_uppercase() && lower_before {
            out.push('_');
        }
        lower_before = c.is_ascii_lowercase() || c.is_ascii_digit();
        out.push(c.to_ascii_lowercase());
    }
    const KEYWORDS: [&str; 12] =
        ["type", "move", "ref", "match", "mod", "box", "use", "fn", "impl", "loop", "where", "in"];
    if KEYWORDS.contains(&out.as_str()) {
        out.insert_str(0, "r#");
    }
    out
}
