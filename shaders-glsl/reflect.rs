//! Reads from a compute kernel's SPIR-V what the host must agree with: buffers, push constants,
//! specialisation constants, workgroup size, shared memory, capabilities.
//!
//! The one decision: layouts are accepted only if a `repr(C)` struct of `f32`/`i32`/`u32` arrays has
//! them without padding. A gap, a `vec3` or a 64-bit type is an error here, at build time, and the fix is to
//! write the padding in the GLSL, where both sides can see it.
//!
//! Numbers below are those of the SPIR-V specification, version 1.3, section 3.

use std::collections::{BTreeMap, HashMap};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scalar {
    Float,
    Int,
    Uint,
    Bool,
}

#[derive(Clone, Debug, PartialEq)]
pub enum Type {
    Scalar(Scalar),
    Vector(Scalar, u32),
    /// Columns of four floats.
    Matrix(u32),
    Array {
        of: Box<Type>,
        len: u32,
        stride: u32,
    },
    Runtime {
        of: Box<Type>,
        stride: u32,
    },
    Struct(Struct),
}

#[derive(Clone, Debug, PartialEq)]
pub struct Struct {
    pub name: String,
    pub members: Vec<Member>,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Member {
    pub name: String,
    pub offset: u32,
    pub ty: Type,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    Read,
    Write,
    ReadWrite,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Buffer {
    pub binding: u32,
    pub name: String,
    pub access: Access,
    /// Of a texel buffer, the scalar of a component.
    pub element: Type,
    /// Read as texels: variants alone do so.
    pub texels: bool,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Spec {
    pub id: u32,
    pub name: String,
    pub ty: Scalar,
    pub default: u32,
}

#[derive(Clone, Debug)]
pub struct Kernel {
    pub buffers: Vec<Buffer>,
    pub push: Option<Struct>,
    pub specs: Vec<Spec>,
    pub local: [u32; 3],
    /// Specialisation constant that sets a dimension of `local`.
    pub local_id: [Option<u32>; 3],
    pub shared_bytes: u32,
    pub capabilities: Vec<u32>,
}

/// Storage buffers of one kernel; the smallest limit among Vulkan 1.1 boards is 8 without doubt.
pub const BUFFERS_MAX: usize = 8;
/// Bytes of push constants every Vulkan device has.
pub const PUSH_MAX: u32 = 128;
pub const SPECS_MAX: usize = 16;

pub fn reflect(words: &[u32]) -> Result<Kernel, String> {
    Module::parse(words)?.kernel()
}

impl Type {
    /// Bytes, without the padding an array of it may add.
    pub fn size(&self) -> u32 {
        match self {
            Type::Scalar(_) => 4,
            Type::Vector(_, n) => 4 * n,
            Type::Matrix(columns) => 16 * columns,
            Type::Array { of, len, stride } => len * if *stride == 0 { of.size() } else { *stride },
            Type::Runtime { .. } => 0,
            Type::Struct(s) => s.size(),
        }
    }

    /// Refuses what has no padding-free twin in Rust.
    fn check(&self, place: &str) -> Result<(), String> {
        match self {
            Type::Scalar(Scalar::Bool) => Err(format!("{place}: a bool has no memory layout, use uint")),
            Type::Vector(_, 3) => Err(format!(
                "{place}: vec3 is padded to 16 bytes, use vec4 or three floats; vec3 is refused in buffers"
            )),
            Type::Array { of, stride, .. } | Type::Runtime { of, stride } => {
                of.check(place)?;
                if of.size() != *stride {
                    return Err(format!(
                        "{place}: array elements are {} bytes but {stride} apart: write {} bytes of padding into the struct",
                        of.size(),
                        stride - of.size()
                    ));
                }
                Ok(())
            }
            Type::Struct(s) => s.check(),
            _ => Ok(()),
        }
    }
}

impl Struct {
    pub fn size(&self) -> u32 {
        self.members.last().map_or(0, |m| m.offset + m.ty.size())
    }

    fn check(&self) -> Result<(), String> {
        let mut end = 0;
        for m in &self.members {
            let place = format!("struct {}, member {}", self.name, m.name);
            m.ty.check(&place)?;
            if m.offset != end {
                return Err(format!(
                    "{place}: starts at byte {} but the member before ends at {end}: reorder, or write the padding out",
                    m.offset
                ));
            }
            end += m.ty.size();
        }
        Ok(())
    }
}

/// The tables of a SPIR-V module, as written.
#[derive(Default)]
struct Module {
    names: HashMap<u32, String>,
    member_names: HashMap<(u32, u32), String>,
    decorations: HashMap<(u32, u32), u32>,
    member_decorations: HashMap<(u32, u32, u32), u32>,
    /// Opcode and operands (without the result id) of types and constants.
    defined: HashMap<u32, (u32, Vec<u32>)>,
    variables: Vec<(u32, u32, u32)>,
    local: Option<[u32; 3]>,
    local_ids: Option<[u32; 3]>,
    capabilities: Vec<u32>,
}

const NON_WRITABLE: u32 = 24;
const NON_READABLE: u32 = 25;
const SPEC_ID: u32 = 1;
const BUILT_IN: u32 = 11;
const WORKGROUP_SIZE: u32 = 25;
const STORAGE_CONSTANT: u32 = 0;
const STORAGE_UNIFORM: u32 = 2;
const STORAGE_WORKGROUP: u32 = 4;
const STORAGE_PUSH: u32 = 9;
const STORAGE_BUFFER: u32 = 12;

impl Module {
    fn parse(words: &[u32]) -> Result<Module, String> {
        if words.len() < 5 || words[0] != 0x0723_0203 {
            return Err("not a SPIR-V module".into());
        }
        let mut m = Module::default();
        let mut at = 5;
        while at < words.len() {
            let (opcode, count) = (words[at] & 0xffff, (words[at] >> 16) as usize);
            if count == 0 || at + count > words.len() {
                return Err(format!("SPIR-V instruction at word {at} overruns the module"));
            }
            m.instruction(opcode, &words[at + 1..at + count])?;
            at += count;
        }
        Ok(m)
    }

    fn instruction(&mut self, opcode: u32, w: &[u32]) -> Result<(), String> {
        let rest = |n: usize| w.get(n).copied().unwrap_or(0);
        match opcode {
            5 => drop(self.names.insert(w[0], text(&w[1..]))),
            6 => drop(self.member_names.insert((w[0], w[1]), text(&w[2..]))),
            16 if w[1] == 17 => self.local = Some([w[2], w[3], w[4]]),
            331 if w[1] == 38 => self.local_ids = Some([w[2], w[3], w[4]]),
            17 => self.capabilities.push(w[0]),
            // Types: the result id comes first.
            19..=33 => drop(self.defined.insert(w[0], (opcode, w[1..].to_vec()))),
            // Constants: the result type comes first, and stays first among the operands.
            41..=44 | 46 | 48..=52 => {
                let mut operands = vec![w[0]];
                operands.extend(&w[2..]);
                self.defined.insert(w[1], (opcode, operands));
            }
            59 => self.variables.push((w[0], w[1], w[2])),
            71 => drop(self.decorations.insert((w[0], w[1]), rest(2))),
            72 => drop(self.member_decorations.insert((w[0], w[1], w[2]), rest(3))),
            _ => {}
        }
        Ok(())
    }

    fn kernel(&self) -> Result<Kernel, String> {
        let mut k = Kernel {
            buffers: Vec::new(),
            push: None,
            specs: self.specs()?,
            local: [1; 3],
            local_id: [None; 3],
            shared_bytes: 0,
            capabilities: self.capabilities.clone(),
        };
        self.local_size(&mut k)?;
        for &(pointer, id, storage) in &self.variables {
            let pointee = match self.define(pointer)? {
                (32, w) => w[1],
                _ => return Err(format!("variable {id} is no pointer")),
            };
            match storage {
                STORAGE_WORKGROUP => k.shared_bytes += self.ty(pointee, None)?.size(),
                STORAGE_PUSH => k.push = Some(self.push(pointee)?),
                STORAGE_BUFFER => k.buffers.push(self.buffer(id, pointee)?),
                STORAGE_CONSTANT => k.buffers.push(self.texels(id, pointee)?),
                STORAGE_UNIFORM => {
                    return Err("uniform blocks are not used here: push constants or a readonly buffer".into())
                }
                _ => {}
            }
        }
        k.buffers.sort_by_key(|b| b.binding);
        if let Some(twice) = k.buffers.windows(2).find(|b| b[0].binding == b[1].binding) {
            return Err(format!(
                "buffers `{}` and `{}` share binding {}",
                twice[0].name, twice[1].name, twice[0].binding
            ));
        }
        if k.buffers.len() > BUFFERS_MAX {
            return Err(format!("{} storage buffers; every kernel has to do with {BUFFERS_MAX}", k.buffers.len()));
        }
        if k.specs.len() > SPECS_MAX {
            return Err(format!("{} specialisation constants; at most {SPECS_MAX}", k.specs.len()));
        }
        Ok(k)
    }

    fn push(&self, id: u32) -> Result<Struct, String> {
        let Type::Struct(s) = self.ty(id, None)? else { return Err("the push constant is no block".into()) };
        s.check()?;
        if s.size() > PUSH_MAX {
            return Err(format!("push constants take {} bytes; devices have {PUSH_MAX}", s.size()));
        }
        Ok(s)
    }

    fn buffer(&self, id: u32, block: u32) -> Result<Buffer, String> {
        let Type::Struct(s) = self.ty(block, None)? else { return Err(format!("buffer {id} is no block")) };
        let name = match self.names.get(&id) {
            Some(n) if !n.is_empty() => n.clone(),
            _ => s.name.clone(),
        };
        let binding = self.binding(id, &name)?;
        let all = |decoration: u32| {
            self.decorations.contains_key(&(id, decoration))
                || (0..s.members.len() as u32).all(|m| self.member_decorations.contains_key(&(block, m, decoration)))
        };
        let access = match (all(NON_WRITABLE), all(NON_READABLE)) {
            (true, true) => return Err(format!("buffer `{name}` is neither read nor written")),
            (true, false) => Access::Read,
            (false, true) => Access::Write,
            (false, false) => Access::ReadWrite,
        };
        let place = format!("buffer `{name}`");
        let element = match s.members.as_slice() {
            [Member { ty: Type::Runtime { of, .. }, .. }] => {
                s.members[0].ty.check(&place)?;
                (**of).clone()
            }
            members if members.iter().any(|m| matches!(m.ty, Type::Runtime { .. })) => {
                return Err(format!("{place}: one runtime array a block, and nothing beside it"));
            }
            _ => {
                s.check()?;
                Type::Struct(s)
            }
        };
        Ok(Buffer { binding, name, access, element, texels: false })
    }

    fn binding(&self, id: u32, name: &str) -> Result<u32, String> {
        if self.decorations.get(&(id, 34)).copied().unwrap_or(0) != 0 {
            return Err(format!("buffer `{name}`: only descriptor set 0 is used"));
        }
        self.decorations.get(&(id, 33)).copied().ok_or(format!("buffer `{name}` has no binding"))
    }

    /// A `samplerBuffer` or `usamplerBuffer`.
    fn texels(&self, id: u32, sampled: u32) -> Result<Buffer, String> {
        const DIM_BUFFER: u32 = 5;
        let name = self.names.get(&id).cloned().unwrap_or_default();
        let image = match self.define(sampled)? {
            (27, w) => self.define(w[0])?,
            other => other,
        };
        match image {
            (25, w) if w[1] == DIM_BUFFER => {
                let binding = self.binding(id, &name)?;
                let element = Type::Scalar(self.scalar(w[0])?);
                Ok(Buffer { binding, name, access: Access::Read, element, texels: true })
            }
            _ => Err(format!("`{name}`: of images only buffers of texels are used here")),
        }
    }

    /// Specialisation constants by id. `local_size_x_id` makes a second, nameless constant of the same id.
    fn specs(&self) -> Result<Vec<Spec>, String> {
        let mut by_id: BTreeMap<u32, Spec> = BTreeMap::new();
        for (&(target, decoration), &id) in &self.decorations {
            if decoration != SPEC_ID {
                continue;
            }
            let name = self.names.get(&target).cloned().unwrap_or_default();
            let (ty, default) = match self.define(target)? {
                (48, _) => (Scalar::Bool, 1),
                (49, _) => (Scalar::Bool, 0),
                (50, w) if w.len() == 2 => (self.scalar(w[0])?, w[1]),
                _ => return Err(format!("specialisation constant {id}: only bool and 32-bit types")),
            };
            match by_id.get(&id) {
                Some(old) if old.default != default => {
                    return Err(format!("specialisation constant {id} has defaults {} and {default}", old.default));
                }
                Some(old) if !old.name.is_empty() => {}
                _ => drop(by_id.insert(id, Spec { id, name, ty, default })),
            }
        }
        let mut specs: Vec<Spec> = by_id.into_values().collect();
        for s in &mut specs {
            if s.name.is_empty() {
                s.name = format!("local_size_{}", s.id);
            }
        }
        Ok(specs)
    }

    fn local_size(&self, k: &mut Kernel) -> Result<(), String> {
        let built_in = self
            .decorations
            .iter()
            .find(|(&(_, decoration), &value)| decoration == BUILT_IN && value == WORKGROUP_SIZE)
            .map(|(&(id, _), _)| self.define(id))
            .transpose()?;
        let ids: Vec<u32> = match (built_in, self.local_ids) {
            (Some((44 | 51, w)), _) => w[1..].to_vec(),
            (_, Some(ids)) => ids.to_vec(),
            _ => {
                k.local = self.local.ok_or("no workgroup size: declare layout(local_size_x = ..) in")?;
                return Ok(());
            }
        };
        for (axis, &id) in ids.iter().enumerate().take(3) {
            k.local[axis] = self.value(id)?;
            k.local_id[axis] = self.decorations.get(&(id, SPEC_ID)).copied();
        }
        Ok(())
    }

    fn define(&self, id: u32) -> Result<(u32, &[u32]), String> {
        self.defined.get(&id).map(|(op, w)| (*op, w.as_slice())).ok_or(format!("SPIR-V id {id} is not defined"))
    }

    fn scalar(&self, id: u32) -> Result<Scalar, String> {
        match self.define(id)? {
            (20, _) => Ok(Scalar::Bool),
            (21, [32, 1]) => Ok(Scalar::Int),
            (21, [32, _]) => Ok(Scalar::Uint),
            (22, [32, ..]) => Ok(Scalar::Float),
            (21 | 22, [bits, ..]) => Err(format!("{bits}-bit numbers are outside the baseline")),
            _ => Err(format!("SPIR-V type {id} is no scalar")),
        }
    }

    /// `matrix_stride` is known only to the struct member that holds the matrix.
    fn ty(&self, id: u32, matrix_stride: Option<u32>) -> Result<Type, String> {
        let stride = self.decorations.get(&(id, 6)).copied().unwrap_or(0);
        Ok(match self.define(id)? {
            (20..=22, _) => Type::Scalar(self.scalar(id)?),
            (23, w) => Type::Vector(self.scalar(w[0])?, w[1]),
            (24, w) => match (self.ty(w[0], None)?, matrix_stride) {
                (Type::Vector(Scalar::Float, 4), Some(16) | None) => Type::Matrix(w[1]),
                _ => return Err("matrices need columns of four floats".into()),
            },
            (28, w) => Type::Array { of: Box::new(self.ty(w[0], matrix_stride)?), len: self.value(w[1])?, stride },
            (29, w) => Type::Runtime { of: Box::new(self.ty(w[0], matrix_stride)?), stride },
            (30, w) => Type::Struct(self.structure(id, w)?),
            (op, _) => return Err(format!("SPIR-V type with opcode {op} is not used here")),
        })
    }

    fn structure(&self, id: u32, members: &[u32]) -> Result<Struct, String> {
        let mut s = Struct { name: self.names.get(&id).cloned().unwrap_or_default(), members: Vec::new() };
        for (i, &ty) in members.iter().enumerate() {
            let key = |decoration| (id, i as u32, decoration);
            if self.member_decorations.contains_key(&key(4)) {
                return Err(format!("struct {}: row-major matrices are not used here", s.name));
            }
            s.members.push(Member {
                name: self.member_names.get(&(id, i as u32)).cloned().unwrap_or_else(|| format!("m{i}")),
                offset: self.member_decorations.get(&key(35)).copied().unwrap_or(0),
                ty: self.ty(ty, self.member_decorations.get(&key(7)).copied())?,
            });
        }
        Ok(s)
    }

    /// A constant's value, specialisation constants at their defaults.
    fn value(&self, id: u32) -> Result<u32, String> {
        match self.define(id)? {
            (43 | 50, w) if w.len() == 2 => Ok(w[1]),
            (52, w) if w.len() == 4 => {
                let (a, b) = (self.value(w[2])?, self.value(w[3])?);
                match w[1] {
                    128 => a.checked_add(b),
                    130 => a.checked_sub(b),
                    132 => a.checked_mul(b),
                    134 | 135 => a.checked_div(b),
                    194 => a.checked_shr(b),
                    196 => a.checked_shl(b),
                    _ => None,
                }
                .ok_or(format!("cannot evaluate constant expression {} of {a} and {b}", w[1]))
            }
            (op, _) => Err(format!("SPIR-V constant with opcode {op} cannot size anything")),
        }
    }
}

/// A literal string: bytes of little-endian words, up to the first zero.
fn text(words: &[u32]) -> String {
    let bytes: Vec<u8> = words.iter().flat_map(|w| w.to_le_bytes()).take_while(|&b| b != 0).collect();
    String::from_utf8_lossy(&bytes).into_owned()
}
