//! Reads modules as the compiler does, by their `mod` declarations, and notes every path in them.

use super::imports::{Named, Path, Scope, Sources};
use proc_macro2::{Delimiter, TokenStream, TokenTree};
use std::collections::BTreeMap;
use syn::{
    Attribute, Block, File, ImplItemFn, Item, ItemMod, LitStr, Macro, Meta, UseTree, Visibility,
    visit::{self, Visit},
};

/// Reads one file.
pub struct Reader<'a> {
    sources: &'a mut Sources,
    files: &'a BTreeMap<String, String>,
    file: &'a str,
    module: Path,
    test: bool,
    /// Blocks around: what is declared in a function is no name of the module.
    blocks: usize,
}

impl<'a> Reader<'a> {
    /// Reads the file of `module` and those of the modules that it declares.
    pub fn read(sources: &'a mut Sources, files: &'a BTreeMap<String, String>, file: &'a str, module: Path, test: bool) {
        let syntax = parse(file, &files[file]);
        sources.scopes.insert(module.clone(), Scope { file: file.to_owned(), ..Scope::default() });
        sources.files.insert(file.to_owned(), module.clone());
        if test {
            sources.tests.insert(file.to_owned());
        }
        Reader { sources, files, file, module, test, blocks: 0 }.visit_file(&syntax);
    }

    fn note(&mut self, path: Path) {
        self.sources.named.push(Named { file: self.file.to_owned(), module: self.module.clone(), path, test: self.test });
    }

    fn scope(&mut self) -> Option<&mut Scope> {
        if self.blocks == 0 { self.sources.scopes.get_mut(&self.module) } else { None }
    }

    fn within_test(&mut self, attributes: &[Attribute], read: impl FnOnce(&mut Self)) {
        let before = self.test;
        self.test |= attributes.iter().any(is_for_tests);
        read(self);
        self.test = before;
    }

    fn read_use(&mut self, tree: &UseTree) {
        for (path, name) in expanded(tree) {
            if let Some(scope) = self.scope() {
                match name {
                    Some(name) => _ = scope.used.insert(name, path.clone()),
                    None => scope.stars.push(path.clone()),
                }
            }
            self.note(path);
        }
    }

    fn read_module(&mut self, item: &ItemMod) {
        let name = item.ident.to_string();
        let module = [self.module.as_slice(), std::slice::from_ref(&name)].concat();
        match &item.content {
            Some((_, items)) => {
                self.sources.scopes.insert(module, Scope { file: self.file.to_owned(), ..Scope::default() });
                self.module.push(name);
                items.iter().for_each(|item| self.visit_item(item));
                self.module.pop();
            }
            None => {
                let file = self.file_of(item, &name);
                Reader::read(self.sources, self.files, file, module, self.test);
            }
        }
    }

    fn file_of(&self, item: &ItemMod, name: &str) -> &'a str {
        let (folder, own) = self.file.rsplit_once('/').map_or(("", self.file), |(folder, own)| (folder, own));
        let own = own.trim_end_matches(".rs");
        let below = if ["mod", "lib"].contains(&own) { String::new() } else { format!("{own}/") };
        let mut places = vec![format!("{below}{name}.rs"), format!("{below}{name}/mod.rs")];
        places.extend(item.attrs.iter().filter(|attribute| attribute.path().is_ident("path")).filter_map(text_of));
        let places = places.into_iter().map(|place| if folder.is_empty() { place } else { format!("{folder}/{place}") });
        let found = places.filter_map(|place| self.files.get_key_value(&place)).next();
        found.unwrap_or_else(|| panic!("{}: where is `mod {name}`?", self.file)).0
    }

    /// Paths in what is not parsed: macros, and the arguments of attributes. `before` stands before each, as in a `use` tree.
    fn read_tokens(&mut self, tokens: TokenStream, before: &[String]) {
        let (mut path, mut colons) = (before.to_vec(), 0);
        for token in tokens {
            let begins = path.len() == before.len();
            match token {
                TokenTree::Ident(name) if begins || colons == 2 => {
                    path.push(name.to_string());
                    colons = 0;
                    continue;
                }
                TokenTree::Punct(mark) if mark.as_char() == ':' && !begins && colons < 2 => {
                    colons += 1;
                    continue;
                }
                _ => {}
            }
            let (ended, after) = (std::mem::replace(&mut path, before.to_vec()), std::mem::take(&mut colons));
            match token {
                TokenTree::Group(group) if after == 2 && group.delimiter() == Delimiter::Brace => {
                    self.read_tokens(group.stream(), &ended);
                    continue;
                }
                TokenTree::Group(group) => self.read_tokens(group.stream(), &[]),
                TokenTree::Ident(name) => path.push(name.to_string()),
                TokenTree::Punct(_) | TokenTree::Literal(_) => {}
            }
            if ended.len() > before.len() {
                self.note_joined(ended);
            }
        }
        if path.len() > before.len() {
            self.note_joined(path);
        }
    }

    fn note_joined(&mut self, path: Path) {
        if path.len() > 1 {
            self.note(path);
        }
    }
}

impl<'ast> Visit<'ast> for Reader<'_> {
    fn visit_item(&mut self, item: &'ast Item) {
        self.within_test(attributes(item), |reader| {
            if let (Some(name), Some(scope)) = (defined(item), reader.scope()) {
                scope.defined.insert(name);
            }
            match item {
                Item::Use(item) if item.leading_colon.is_none() => reader.read_use(&item.tree),
                Item::Use(_) => {}
                Item::Mod(item) => reader.read_module(item),
                other => visit::visit_item(reader, other),
            }
        });
    }

    fn visit_impl_item_fn(&mut self, item: &'ast ImplItemFn) {
        self.within_test(&item.attrs, |reader| visit::visit_impl_item_fn(reader, item));
    }

    fn visit_block(&mut self, block: &'ast Block) {
        self.blocks += 1;
        visit::visit_block(self, block);
        self.blocks -= 1;
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        if path.leading_colon.is_none() {
            self.note_joined(path.segments.iter().map(|segment| segment.ident.to_string()).collect());
        }
        visit::visit_path(self, path);
    }

    fn visit_macro(&mut self, item: &'ast Macro) {
        visit::visit_macro(self, item);
        self.read_tokens(item.tokens.clone(), &[]);
    }

    fn visit_attribute(&mut self, attribute: &'ast Attribute) {
        if let Meta::List(list) = &attribute.meta {
            self.read_tokens(list.tokens.clone(), &[]);
            // `#[serde(with = "crate::..")]`
            let texts = list.tokens.clone().into_iter().filter_map(|token| syn::parse2::<LitStr>(token.into()).ok());
            let paths = texts.filter_map(|text| text.parse::<syn::Path>().ok());
            paths.collect::<Vec<_>>().iter().for_each(|path| self.visit_path(path));
        }
    }

    /// `pub(in crate::model)` imports nothing.
    fn visit_visibility(&mut self, _: &'ast Visibility) {}
}

/// The syntax of a file.
pub fn parse(file: &str, text: &str) -> File {
    syn::parse_file(text).unwrap_or_else(|error| panic!("{file}: {error}"))
}

/// Every path of a `use` tree, in order, and the name that it brings; none for a star.
pub fn expanded(tree: &UseTree) -> Vec<(Path, Option<String>)> {
    fn walk(tree: &UseTree, before: &[String], found: &mut Vec<(Path, Option<String>)>) {
        let with =
            |name: &syn::Ident| if name == "self" && !before.is_empty() { before.to_vec() } else { [before, &[name.to_string()]].concat() };
        match tree {
            UseTree::Path(path) => walk(&path.tree, &with(&path.ident), found),
            UseTree::Name(name) => found.push((with(&name.ident), with(&name.ident).pop())),
            UseTree::Rename(name) => found.push((with(&name.ident), Some(name.rename.to_string()))),
            UseTree::Glob(_) => found.push((before.to_vec(), None)),
            UseTree::Group(group) => group.items.iter().for_each(|tree| walk(tree, before, found)),
        }
    }
    let mut found = Vec::new();
    walk(tree, &[], &mut found);
    found
}

/// `#[cfg(test)]`.
fn is_for_tests(attribute: &Attribute) -> bool {
    attribute.path().is_ident("cfg") && matches!(&attribute.meta, Meta::List(list) if list.tokens.to_string() == "test")
}

/// The text of `#[name = "text"]`.
fn text_of(attribute: &Attribute) -> Option<String> {
    let syn::Expr::Lit(literal) = &attribute.meta.require_name_value().ok()?.value else { return None };
    let syn::Lit::Str(text) = &literal.lit else { return None };
    Some(text.value())
}

fn attributes(item: &Item) -> &[Attribute] {
    match item {
        Item::Const(item) => &item.attrs,
        Item::Enum(item) => &item.attrs,
        Item::Fn(item) => &item.attrs,
        Item::Impl(item) => &item.attrs,
        Item::Macro(item) => &item.attrs,
        Item::Mod(item) => &item.attrs,
        Item::Static(item) => &item.attrs,
        Item::Struct(item) => &item.attrs,
        Item::Trait(item) => &item.attrs,
        Item::Type(item) => &item.attrs,
        Item::Use(item) => &item.attrs,
        _ => &[],
    }
}

/// The name of an item other than a module.
fn defined(item: &Item) -> Option<String> {
    let name = match item {
        Item::Const(item) => &item.ident,
        Item::Enum(item) => &item.ident,
        Item::Fn(item) => &item.sig.ident,
        Item::Macro(item) => item.ident.as_ref()?,
        Item::Static(item) => &item.ident,
        Item::Struct(item) => &item.ident,
        Item::Trait(item) => &item.ident,
        Item::Type(item) => &item.ident,
        Item::Union(item) => &item.ident,
        _ => return None,
    };
    Some(name.to_string())
}
