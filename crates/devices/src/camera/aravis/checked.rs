// SPDX-License-Identifier: MIT OR Apache-2.0
//! Calls of Aravis whose bindings trust the camera, with checks.
//!
//! The bindings end the process where Aravis gives a null text without an error (an enumeration whose register
//! matches none of its entries), and where a text is not UTF-8. They use numbers that Aravis may have left unwritten.
//! Here a null text is `None`, and texts of any bytes are converted.

use crate::camera::contract::ImageForm;
use glib::ffi::{GError, GSList};
use glib::prelude::{Cast, IsA};
use glib::translate::{ToGlibPtr, from_glib_full};
use std::ffi::{CStr, CString, c_char, c_void};
use std::ptr::null_mut;

/// Makes a call that may set an error, and gives the value or the error.
fn checked<T>(call: impl FnOnce(*mut *mut GError) -> T) -> Result<T, glib::Error> {
    let mut error = null_mut();
    let value = call(&raw mut error);
    match error.is_null() {
        true => Ok(value),
        // SAFETY: set by Aravis, and ours then.
        false => Err(unsafe { from_glib_full(error) }),
    }
}

/// A name as a C string; it ends at the first zero byte.
fn named(name: &str) -> CString {
    let name = name.split('\0').next().unwrap_or_default();
    CString::new(name).unwrap_or_default()
}

/// A copy of a C string, with a replacement character for bytes that are not UTF-8; `None` for a null pointer.
///
/// # Safety
/// The pointer is null, or of a text that ends with a zero and that does not change during the call.
pub(super) unsafe fn text(pointer: *const c_char) -> Option<String> {
    if pointer.is_null() {
        return None;
    }
    // SAFETY: not null, and what the caller promises.
    Some(unsafe { CStr::from_ptr(pointer) }.to_string_lossy().into_owned())
}

/// Opens the camera at this address.
pub(super) fn open(address: &str) -> Result<aravis::Camera, glib::Error> {
    let address = named(address);
    // SAFETY: the text lives during the call, and `error` is null, as GLib asks.
    let camera = checked(|error| unsafe { aravis_sys::arv_camera_new(address.as_ptr(), error) })?;
    if camera.is_null() {
        return Err(glib::Error::new(aravis::DeviceError::NotFound, "Aravis gave no camera"));
    }
    // SAFETY: a new reference, which is ours.
    Ok(unsafe { from_glib_full(camera) })
}

/// Vendor, model and serial number; empty where the camera does not report them.
pub(super) fn identity(camera: &aravis::Camera) -> [String; 3] {
    type Ask = unsafe extern "C" fn(*mut aravis_sys::ArvCamera, *mut *mut GError) -> *const c_char;
    let asks: [Ask; 3] = [
        aravis_sys::arv_camera_get_vendor_name,
        aravis_sys::arv_camera_get_model_name,
        aravis_sys::arv_camera_get_device_serial_number,
    ];
    asks.map(|ask| {
        // SAFETY: the camera lives during the call; the text belongs to it, and is copied at once.
        let found = checked(|error| unsafe { text(ask(camera.to_glib_none().0, error)) });
        found.ok().flatten().unwrap_or_default()
    })
}

/// A text, or the current entry of an enumeration; `None` where its register matches no entry.
pub(super) fn string(device: &aravis::Device, feature: &str) -> Result<Option<String>, glib::Error> {
    let feature = named(feature);
    // SAFETY: device and name live during the call; the text belongs to the device, and is copied at once.
    checked(|error| unsafe {
        text(aravis_sys::arv_device_get_string_feature_value(
            device.to_glib_none().0,
            feature.as_ptr(),
            error,
        ))
    })
}

/// A function of Aravis that gives the least and the largest value of a number.
type AskBounds<T> =
    unsafe extern "C" fn(*mut aravis_sys::ArvDevice, *const c_char, *mut T, *mut T, *mut *mut GError);

/// The least and the largest value of a number; the given ones where Aravis leaves them unwritten.
fn bounds<T: Copy>(
    device: &aravis::Device,
    feature: &str,
    (mut min, mut max): (T, T),
    ask: AskBounds<T>,
) -> Result<(T, T), glib::Error> {
    let feature = named(feature);
    // SAFETY: device, name and both places live during the call.
    checked(|error| unsafe {
        ask(device.to_glib_none().0, feature.as_ptr(), &raw mut min, &raw mut max, error)
    })?;
    Ok((min, max))
}

/// The least and the largest value of a whole number.
pub(super) fn integer_bounds(device: &aravis::Device, feature: &str) -> Result<(i64, i64), glib::Error> {
    let any = (i64::MIN, i64::MAX);
    bounds(device, feature, any, aravis_sys::arv_device_get_integer_feature_bounds)
}

/// The least and the largest value of a number.
pub(super) fn float_bounds(device: &aravis::Device, feature: &str) -> Result<(f64, f64), glib::Error> {
    bounds(device, feature, (f64::MIN, f64::MAX), aravis_sys::arv_device_get_float_feature_bounds)
}

/// Reads a bootstrap register of 32 bits.
pub(super) fn register(device: &impl IsA<aravis::Device>, address: u64) -> Result<u32, glib::Error> {
    let device = device.upcast_ref::<aravis::Device>();
    let mut value = 0;
    // SAFETY: the device and the place live during the call.
    let done = checked(|error| unsafe {
        aravis_sys::arv_device_read_register(device.to_glib_none().0, address, &raw mut value, error)
    })?;
    match done {
        0 => Err(glib::Error::new(aravis::DeviceError::TransferError, "a register could not be read")),
        _ => Ok(value),
    }
}

/// The entries of an enumeration that can be selected now.
pub(super) fn entries_now(device: &aravis::Device, feature: &str) -> Result<Vec<String>, glib::Error> {
    let feature = named(feature);
    let mut count = 0;
    // SAFETY: device, name and place live during the call.
    let list = checked(|error| unsafe {
        aravis_sys::arv_device_dup_available_enumeration_feature_values_as_strings(
            device.to_glib_none().0,
            feature.as_ptr(),
            &raw mut count,
            error,
        )
    })?;
    if list.is_null() {
        return Ok(Vec::new());
    }
    let count = usize::try_from(count).unwrap_or(0);
    // SAFETY: Aravis has made a list of `count` texts, which belong to the description.
    let names = (0..count).filter_map(|place| unsafe { text(*list.add(place)) }).collect();
    // SAFETY: the list is ours, not its texts, and it is freed once.
    unsafe { glib::ffi::g_free(list.cast::<c_void>()) };
    Ok(names)
}

/// The name of a node of the description.
pub(super) fn name_of(node: &impl IsA<aravis::GcFeatureNode>) -> Option<String> {
    let node = node.upcast_ref::<aravis::GcFeatureNode>();
    // SAFETY: the node lives during the call; the text belongs to it, and is copied at once.
    unsafe { text(aravis_sys::arv_gc_feature_node_get_name(node.to_glib_none().0)) }
}

/// The XML element name of a node of the description.
pub(super) fn tag_of(node: &aravis::DomNode) -> Option<String> {
    // SAFETY: the node lives during the call; the text belongs to its class, and is copied at once.
    unsafe { text(aravis_sys::arv_dom_node_get_node_name(node.to_glib_none().0)) }
}

/// The unit of a number, as the description spells it.
pub(super) fn unit_of(node: &aravis::GcFeatureNode) -> Option<String> {
    if let Some(float) = node.dynamic_cast_ref::<aravis::GcFloat>() {
        // SAFETY: the node lives during the call; the text belongs to it, and is copied at once.
        return unsafe { text(aravis_sys::arv_gc_float_get_unit(float.to_glib_none().0)) };
    }
    let whole = node.dynamic_cast_ref::<aravis::GcInteger>()?;
    // SAFETY: as above.
    unsafe { text(aravis_sys::arv_gc_integer_get_unit(whole.to_glib_none().0)) }
}

/// The names of the features in a category of the description.
pub(super) fn features_of(category: &aravis::GcCategory) -> Vec<String> {
    let mut names = Vec::new();
    // SAFETY: the category lives during the call; the list belongs to it.
    let mut item: *const GSList =
        unsafe { aravis_sys::arv_gc_category_get_features(category.to_glib_none().0) };
    while !item.is_null() {
        // SAFETY: an item of the list, which does not change until the features are requested again.
        let (data, next) = unsafe { ((*item).data, (*item).next) };
        // SAFETY: the list holds texts.
        names.extend(unsafe { text(data.cast::<c_char>()) });
        item = next;
    }
    names
}

/// The image of a buffer with one part, as its leader describes it; zeros where the buffer holds no image.
pub(super) fn image_of(buffer: &aravis::Buffer) -> ImageForm {
    let (mut region, mut padding) = ([0; 4], (0, 0));
    let [x, y, width, height] = &mut region;
    let buffer = buffer.to_glib_none();
    // SAFETY: buffer and places live during the calls; the caller has seen that there is one part.
    let pixel_format = unsafe {
        aravis_sys::arv_buffer_get_image_region(buffer.0, x, y, width, height);
        aravis_sys::arv_buffer_get_image_padding(buffer.0, &raw mut padding.0, &raw mut padding.1);
        aravis_sys::arv_buffer_get_image_pixel_format(buffer.0)
    };
    let [x, y, width, height] = region;
    ImageForm { pixel_format, size: (width, height), offset: (x, y), padding }
}

/// Number of bytes that arrived in a buffer, each at its place.
pub(super) fn bytes_of(buffer: &aravis::Buffer) -> usize {
    let mut bytes = 0;
    // SAFETY: buffer and place live during the call, and nothing is done with the memory.
    unsafe { aravis_sys::arv_buffer_get_data(buffer.to_glib_none().0, &raw mut bytes) };
    bytes
}
