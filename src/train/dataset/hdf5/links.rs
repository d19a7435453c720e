//! The names that a group holds. The reader's own look-up passes over a link that leads nowhere, so absent and unreadable look alike; here
//! they do not.

use hdf5_reader::{
    Hdf5File,
    btree_v1::collect_btree_v1_leaves_storage,
    btree_v2::{BTreeV2Header, BTreeV2Record, collect_btree_v2_records_storage},
    error::Result,
    fractal_heap::FractalHeap,
    group::Group,
    io::Cursor,
    local_heap::LocalHeap,
    messages::{
        HdfMessage,
        link::{self, LinkTarget},
        link_info::LinkInfoMessage,
        symbol_table_msg::SymbolTableMessage,
    },
    symbol_table::SymbolTableNode,
};
use std::collections::BTreeMap;

/// What each name of a group leads to.
pub type Links = BTreeMap<String, LinkTarget>;

/// Bytes of an entry of an old group beside its two addresses, and those of one of its nodes before the entries.
const ENTRY_BYTES: usize = 24;
const NODE_HEAD_BYTES: usize = 8;
/// How an entry of an old group says that it is a soft link.
const SOFT: u32 = 2;

/// All names of a group; a group has them in its header, in a heap of their own where they are many, or in a table where the file is old.
///
/// # Errors
/// If the file is damaged.
pub fn links(file: &Hdf5File, group: &Group) -> Result<Links> {
    let mut found = Links::new();
    for message in &file.get_or_parse_header(group.address())?.messages {
        match message {
            HdfMessage::Link(link) => {
                found.insert(link.name.clone(), link.target.clone());
            }
            HdfMessage::LinkInfo(info) if !Cursor::is_undefined_offset(info.fractal_heap_address, group.offset_size()) => {
                in_heap(group, info, &mut found)?;
            }
            HdfMessage::SymbolTable(table) => in_table(group, table, &mut found)?,
            _ => {}
        }
    }
    Ok(found)
}

fn in_heap(group: &Group, info: &LinkInfoMessage, found: &mut Links) -> Result<()> {
    let (storage, offset, length) = (group.storage(), group.offset_size(), group.length_size());
    let heap = FractalHeap::parse_at_storage(storage, info.fractal_heap_address, offset, length)?;
    let index = BTreeV2Header::parse_at_storage(storage, info.btree_name_index_address, offset, length)?;
    for record in collect_btree_v2_records_storage(storage, &index, offset, length, None, &[], None)? {
        if let BTreeV2Record::LinkNameHash { heap_id, .. } = record {
            let bytes = heap.get_object_storage(&heap_id, storage, offset, length)?;
            let link = link::parse(&mut Cursor::new(&bytes), offset, length, bytes.len())?;
            found.insert(link.name, link.target);
        }
    }
    Ok(())
}

fn in_table(group: &Group, table: &SymbolTableMessage, found: &mut Links) -> Result<()> {
    let (storage, offset, length) = (group.storage(), group.offset_size(), group.length_size());
    let heap = LocalHeap::parse_at_storage(storage, table.heap_address, offset, length)?;
    for (_, node) in collect_btree_v1_leaves_storage(storage, table.btree_address, offset, length, None, &[], None)? {
        let head = storage.read_range(node, NODE_HEAD_BYTES)?;
        let entries = usize::from(u16::from_le_bytes([head[6], head[7]]));
        let bytes = storage.read_range(node, NODE_HEAD_BYTES + entries * (2 * usize::from(offset) + ENTRY_BYTES))?;
        for entry in SymbolTableNode::parse(&mut Cursor::new(&bytes), offset, length)?.entries {
            let target = match entry.cache_type {
                SOFT => {
                    let [a, b, c, d, ..] = entry.scratch;
                    let at = u32::from_le_bytes([a, b, c, d]);
                    LinkTarget::Soft { path: heap.get_string_storage(at.into(), storage)? }
                }
                _ => LinkTarget::Hard { address: entry.object_header_address },
            };
            found.insert(heap.get_string_storage(entry.link_name_offset, storage)?, target);
        }
    }
    Ok(())
}
