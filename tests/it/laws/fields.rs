//! In `src/model/agent/` a struct's fields are its file's own.

use super::{crate_sources, hold_but_for, imports::Sources, reader::parse, texts};
use std::collections::{BTreeMap, BTreeSet};
use syn::{
    Expr, ExprField, ImplItemFn, Item, ItemImpl, ItemStruct, Member, Type, Visibility,
    visit::{self, Visit},
};

const ROOM: &str = "model/agent/";
/// What goes in and comes out is plain data.
const PLAIN: &str = "model/agent/types.rs";

/// Fields that other files can read, or do read, (file, field of a struct): each to be closed.
const KNOWN: &[(&str, &str)] = &[];

/// The names of a struct's fields, with those that others can see.
fn fields(item: &ItemStruct) -> impl Iterator<Item = (String, bool)> {
    let name = |(index, field): (usize, &syn::Field)| field.ident.as_ref().map_or(index.to_string(), ToString::to_string);
    item.fields.iter().enumerate().map(move |at| (name(at), !matches!(at.1.vis, Visibility::Inherited)))
}

/// Fields that an `impl` reads of itself.
struct Reads<'a> {
    own: &'a BTreeSet<String>,
    found: BTreeSet<String>,
}

impl<'ast> Visit<'ast> for Reads<'_> {
    fn visit_expr_field(&mut self, field: &'ast ExprField) {
        let of_self = matches!(&*field.base, Expr::Path(base) if base.path.is_ident("self"));
        if let (true, Member::Named(name)) = (of_self, &field.member) {
            self.found.extend(self.own.get(&name.to_string()).cloned());
        }
        visit::visit_expr_field(self, field);
    }

    /// Not what tests read.
    fn visit_impl_item_fn(&mut self, item: &'ast ImplItemFn) {
        if !item.attrs.iter().any(|attribute| attribute.path().is_ident("cfg")) {
            visit::visit_impl_item_fn(self, item);
        }
    }
}

fn name_of(item: &ItemImpl) -> Option<String> {
    let Type::Path(of) = &*item.self_ty else { return None };
    Some(of.path.segments.last()?.ident.to_string())
}

/// Fields that are not private, (the struct's file, field), and private ones of a parent that an `impl` elsewhere reads, (that file, field).
pub fn open_fields(sources: &Sources, texts: &BTreeMap<String, String>) -> BTreeSet<(String, String)> {
    let ours = |file: &&String| file.starts_with(ROOM) && *file != PLAIN && !sources.tests.contains(*file);
    let files: Vec<_> = texts.keys().filter(ours).map(|file| (file, parse(file, &texts[file]).items)).collect();
    let structs: Vec<_> = files.iter().flat_map(|(file, items)| items.iter().map(move |item| (*file, item))).collect();
    let structs = structs.into_iter().filter_map(|(file, item)| if let Item::Struct(item) = item { Some((file, item)) } else { None });
    let (mut found, mut private) = (BTreeSet::new(), BTreeMap::new());
    for (file, item) in structs {
        found.extend(fields(item).filter(|(_, open)| *open).map(|(name, _)| (file.clone(), format!("{}.{name}", item.ident))));
        private.insert(item.ident.to_string(), (file, fields(item).filter(|(_, open)| !open).map(|(name, _)| name).collect()));
    }
    for (file, items) in &files {
        let impls = items.iter().filter_map(|item| if let Item::Impl(item) = item { Some((item, name_of(item)?)) } else { None });
        for (item, name) in impls {
            let Some((_, own)) = private.get(&name).filter(|(home, _)| home != file) else { continue };
            let mut reads = Reads { own, found: BTreeSet::new() };
            reads.visit_item_impl(item);
            found.extend(reads.found.into_iter().map(|field| ((*file).clone(), format!("{name}.{field}"))));
        }
    }
    found
}

#[test]
fn fields_are_read_at_home() {
    hold_but_for(KNOWN, &open_fields(&crate_sources(), &texts()), "fields are for their own file; others ask");
}
