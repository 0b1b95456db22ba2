// SPDX-License-Identifier: MIT OR Apache-2.0
//! Each rule, with descriptions made up for it.

use super::{Amount, Link, Plan, Scale, Want, Wishes, must_be, resolve};
use crate::camera::description::{Access, Description, Feature, Kind};
use crate::config::{AUTO, ActionConfig, CameraWords, Channel, Edge, Mosaic, PacketDelay, Pixel};
use std::collections::BTreeMap;

/// A description made up for a test.
#[derive(Debug, Clone, Default)]
pub(crate) struct Made(pub BTreeMap<String, Feature>);

impl Description for Made {
    fn names(&self) -> Vec<String> {
        self.0.keys().cloned().collect()
    }

    fn feature(&self, name: &str) -> Option<Feature> {
        self.0.get(name).cloned()
    }
}

/// A description from `Name:kind[:unit][=entry,entry][ro]`, separated by blanks.
pub(crate) fn made(text: &str) -> Made {
    let feature = |word: &str| {
        let (word, access) = match word.strip_suffix("!ro") {
            Some(word) => (word, Access::Read),
            None => (word, Access::ReadWrite),
        };
        let (head, entries) = word.split_once('=').unwrap_or((word, ""));
        let mut head = head.split(':');
        let name = head.next().expect("a name").to_owned();
        let kind = match head.next().unwrap_or("enum") {
            "int" => Kind::Integer,
            "float" => Kind::Float,
            "bool" => Kind::Boolean,
            "cmd" => Kind::Command,
            _ => Kind::Enumeration,
        };
        let entries = entries.split(',').filter(|entry| !entry.is_empty()).map(str::to_owned).collect();
        let unit = head.next().map(str::to_owned);
        (name, Feature { kind, access, unit, entries })
    };
    Made(text.split_whitespace().map(feature).collect())
}

/// The features that most cameras have.
const USUAL: &str = "PixelFormat=Mono8,Mono12 Width:int Height:int OffsetX:int OffsetY:int ExposureTime:float:us \
                     Gain:float:dB TriggerMode=Off,On TriggerSource=Line0,Software \
                     TriggerActivation=RisingEdge,FallingEdge \
                     TriggerSelector=FrameStart,AcquisitionStart AcquisitionMode=Continuous,SingleFrame";

fn usual(changes: &[(&str, &str)]) -> Made {
    let mut made = made(USUAL);
    for (name, text) in changes {
        made.0.remove(*name);
        made.0.extend(self::made(text).0);
    }
    made
}

pub(crate) fn wishes() -> Wishes {
    Wishes {
        words: CameraWords { trigger_line: Some(AUTO.to_owned()), ..CameraWords::default() },
        raw: Vec::new(),
        exposure_us: 1000.0,
        size: (1920, 1200),
        channel: Channel::G,
        triggered: true,
        action: None,
        link: Link { cameras: 1, packet_bytes: 9000, period_ns: 8_333_333 },
    }
}

fn stated(change: impl FnOnce(&mut CameraWords)) -> Wishes {
    let mut wishes = wishes();
    change(&mut wishes.words);
    wishes
}

/// The writes in short: `Feature=value`, a number as it is in the feature's own unit.
fn short(plan: &Plan) -> String {
    assert_eq!(plan.troubles, [], "troubles");
    let amount = |amount: &Amount| match amount {
        Amount::Value(value) => value.to_string(),
        Amount::Near { wanted, scale: Scale::Times(times), .. } => (wanted * times).to_string(),
        Amount::Near { wanted, scale: Scale::Ticks(of), .. } => format!("{wanted}/{of}"),
        Amount::Near { wanted, scale: Scale::Clock, .. } => format!("{wanted}us-in-ticks"),
        Amount::Near { wanted, scale: Scale::Gain, .. } => format!("{wanted}dB-by-bounds"),
        Amount::Least => "least".to_owned(),
    };
    let words: Vec<String> =
        plan.writes.iter().map(|write| format!("{}={}", write.feature, amount(&write.amount))).collect();
    words.join(" ")
}

fn trouble(made: &Made, wishes: &Wishes) -> String {
    let plan = resolve(made, wishes);
    assert_eq!(plan.troubles.len(), 1, "{:?}", plan.troubles);
    plan.troubles[0].to_string()
}

/// With action commands as triggers.
fn by_actions(ptp: bool) -> Wishes {
    let action = ActionConfig { device_key: 1, group_key: 2, group_mask: 4, ptp };
    Wishes { action: Some(action), words: CameraWords::default(), ..wishes() }
}

#[test]
fn an_action_is_the_trigger_with_its_keys_and_the_clock_that_all_share() {
    let trigger = |changes: &[(&str, &str)], ptp| {
        let text = short(&resolve(&usual(changes), &by_actions(ptp)));
        text.split_once("TriggerSelector=FrameStart TriggerMode=Off ").expect("a trigger").1.to_owned()
    };
    let keys = "ActionDeviceKey:int ActionGroupKey:int ActionGroupMask:int";
    // FLIR: a selector that can only be read, and PTP before SFNC 2.3.
    let flir = [
        ("TriggerSource", "TriggerSource=Software,Line0,Action0"),
        ("", keys),
        ("ActionSelector", "ActionSelector=Action0!ro"),
        ("GevIEEE1588", "GevIEEE1588:bool"),
    ];
    assert_eq!(
        trigger(&flir, true),
        "ActionDeviceKey=1 ActionGroupKey=2 ActionGroupMask=4 TriggerSource=Action0 GevIEEE1588=true TriggerMode=On"
    );
    // Basler: actions count from 1.
    let basler = [
        ("TriggerSource", "TriggerSource=Line1,Action1,Action2"),
        ("", keys),
        ("ActionSelector", "ActionSelector:int"),
        ("PtpEnable", "PtpEnable:bool"),
    ];
    let musts = |ptp| must_be(&usual(&basler), &by_actions(ptp)).0;
    let names_ptp = |ptp| musts(ptp).iter().any(|must| must.feature == "PtpEnable");
    assert!(names_ptp(false) && !names_ptp(true), "PTP is switched off where nothing is scheduled by it");
    assert_eq!(
        trigger(&basler, false),
        "ActionSelector=least ActionDeviceKey=1 ActionGroupKey=2 ActionGroupMask=4 TriggerSource=Action1 TriggerMode=On"
    );
    // AVT: PTP has a mode.
    let avt = [
        ("TriggerSource", "TriggerSource=Freerun,Line1,Action0,Action1"),
        ("", keys),
        ("PtpMode", "PtpMode=Off,Slave,Master,Auto"),
    ];
    assert!(trigger(&avt, true).contains("TriggerSource=Action0 PtpMode=Auto"));
}

#[test]
fn a_camera_without_actions_keys_or_ptp_is_refused_by_name() {
    let troubles = |changes: &[(&str, &str)], ptp| {
        let plan = resolve(&usual(changes), &by_actions(ptp));
        plan.troubles.iter().map(ToString::to_string).collect::<Vec<_>>()
    };
    let keys = "ActionDeviceKey:int ActionGroupKey:int ActionGroupMask:int";
    let source = ("TriggerSource", "TriggerSource=Line1,Action1");
    let found = troubles(&[("", keys)], false);
    assert!(
        found.len() == 1 && found[0].contains("`Action0` is not an entry of TriggerSource: Line0, Software")
    );
    let found = troubles(&[source], false);
    assert!(found.len() == 3 && found[0].starts_with("the camera has no ActionDeviceKey"), "{found:?}");
    let found = troubles(&[source, ("", keys)], true);
    assert!(found.len() == 1 && found[0].contains("set trigger.ptp = false"), "{found:?}");
}

#[test]
fn an_ordinary_camera_is_set_in_an_order_that_locks_nothing() {
    assert_eq!(
        short(&resolve(&usual(&[]), &wishes())),
        "PixelFormat=Mono8 OffsetX=0 OffsetY=0 Width=1920 Height=1200 ExposureTime=1000 Gain=0 \
         TriggerSelector=AcquisitionStart TriggerMode=Off TriggerSelector=FrameStart TriggerMode=Off \
         TriggerSource=Line0 \
         TriggerActivation=RisingEdge TriggerMode=On"
    );
}

#[test]
fn exposures_of_all_standards_are_found() {
    for (has, expected) in [
        ("ExposureTime:float:us", "ExposureTime=1000"),
        ("ExposureTime:float:ms", "ExposureTime=1"),
        ("ExposureTime:float", "ExposureTime=1000"),
        ("ExposureTimeAbs:float:us ExposureTimeRaw:int", "ExposureTimeAbs=1000"),
        ("ExposureTime:float:us!ro ExposureTimeAbs:float:us", "ExposureTimeAbs=1000"),
        ("ExposureTimeAbs:int", "ExposureTimeAbs=1000"),
        ("ExposureTimeRaw:int ExposureTimeBaseAbs:float:us", "ExposureTimeRaw=1000/ExposureTimeBaseAbs"),
        ("ExposureTimeRaw:int:ns", "ExposureTimeRaw=1000000"),
        ("ExposureTime:float:µs", "ExposureTime=1000"),
        ("ExposureTime:float:μsec", "ExposureTime=1000"),
        ("ExposureTime:float:Âµs", "ExposureTime=1000"),
        ("ExposureTime:float:\u{fffd}s", "ExposureTime=1000"),
        ("ExposureTime:float:[us]", "ExposureTime=1000"),
        ("ExposureTime:float:usecond", "ExposureTime=1000"),
        ("ExposureTime:float:s", "ExposureTime=0.001"),
        ("Exposure:int:us", "Exposure=1000"),
    ] {
        let plan = short(&resolve(&usual(&[("ExposureTime", has)]), &wishes()));
        assert!(plan.contains(&format!(" {expected} ")), "{has}: {plan}");
    }
    let text = trouble(&usual(&[("ExposureTime", "ExposureTimeRaw:int")]), &wishes());
    assert!(text.contains("the length of one"), "{text}");
    let text = trouble(&usual(&[("ExposureTime", "ExposureTimer:cmd")]), &wishes());
    assert!(text.contains("nearest names: ExposureTimer") && text.contains("left_to_settings"), "{text}");
}

#[test]
fn gains_of_all_standards_are_found() {
    for (has, db, expected) in [
        ("Gain:float:dB", 6.0, "Gain=6"),
        ("Gain:float", 6.0, "Gain=6dB-by-bounds"),
        ("GainAbs:float:dB GainRaw:int", 6.0, "GainAbs=6"),
        ("GainRaw:int", 0.0, "GainRaw=least"),
        ("Gain:int", 0.0, "Gain=least"),
        ("GainRaw:float", 0.0, "GainRaw=least"),
        ("GainRaw:float:dB", 6.0, "GainRaw=6"),
        ("Gain:float:% GainRaw:int", 0.0, "Gain=least"),
        ("Gain:float:dB GainSelector=All,Red,Tap1", 3.0, "GainSelector=Red Gain=0 GainSelector=All Gain=3"),
        ("GainRaw:int GainSelector=All,DigitalAll", 0.0, "GainSelector=All GainRaw=least"),
        (
            "GainRaw:int GainSelector=Tap1,Tap2",
            0.0,
            "GainSelector=Tap1 GainRaw=least GainSelector=Tap2 GainRaw=least GainSelector=Tap1 GainRaw=least",
        ),
        (
            "Gain:float:dB GainSelector=DigitalAll,AnalogAll",
            6.0,
            "GainSelector=DigitalAll Gain=0 GainSelector=AnalogAll Gain=6 GainSelector=AnalogAll Gain=6",
        ),
    ] {
        let plan = short(&resolve(&usual(&[("Gain", has)]), &stated(|words| words.gain_db = Some(db))));
        assert!(plan.contains(&format!(" {expected} ")), "{has}: {plan}");
    }
    let six = stated(|words| words.gain_db = Some(6.0));
    assert!(trouble(&usual(&[("Gain", "GainRaw:int")]), &six).contains("steps"));
    assert!(trouble(&usual(&[("Gain", "GainRaw:float")]), &six).contains("steps"));
    assert!(trouble(&usual(&[("Gain", "Width:int")]), &six).contains("is its gain"));
    // A camera without gain has none.
    assert!(!short(&resolve(&usual(&[("Gain", "Width:int")]), &wishes())).contains("Gain"));
}

#[test]
fn the_trigger_that_starts_a_frame_is_found_and_the_others_are_off() {
    for (selector, expected) in [
        ("TriggerSelector=ExposureStart,ExposureActive", "TriggerSelector=ExposureStart "),
        ("TriggerSelector=FrameBurstStart", "TriggerSelector=FrameBurstStart "),
        ("TriggerSelector=ExposureStart,FrameStart,FrameBurstStart", "TriggerSelector=FrameStart "),
    ] {
        let plan = short(&resolve(&usual(&[("TriggerSelector", selector)]), &wishes()));
        let (_, last) = plan.rsplit_once("TriggerSelector").expect("a selector");
        assert!(format!("TriggerSelector{last}").starts_with(expected), "{selector}: {plan}");
        assert!(last.ends_with("TriggerMode=On"), "{plan}");
    }
    let burst =
        usual(&[("TriggerSelector", "TriggerSelector=FrameBurstStart AcquisitionBurstFrameCount:int")]);
    assert!(short(&resolve(&burst, &wishes())).contains("AcquisitionBurstFrameCount=1 TriggerMode=On"));
    // One trigger alone, and one that cannot be selected.
    for without in ["Width:int", "TriggerSelector=FrameStart!ro"] {
        let plan = short(&resolve(&usual(&[("TriggerSelector", without)]), &wishes()));
        assert!(!plan.contains("TriggerSelector") && plan.ends_with("TriggerMode=On"), "{plan}");
    }
    let text = trouble(&usual(&[("TriggerSelector", "TriggerSelector=LineStart,ExposureActive")]), &wishes());
    assert!(
        text.contains("`FrameStart` is not an entry of TriggerSelector: LineStart, ExposureActive"),
        "{text}"
    );
    // Before there was a trigger of frames, that of the acquisition took each; among others it does not.
    let plan = resolve(&usual(&[("TriggerSelector", "TriggerSelector=AcquisitionStart")]), &wishes());
    assert!(short(&plan).contains("TriggerSelector=AcquisitionStart TriggerMode=Off TriggerSource=Line0"));
    assert!(plan.remarks[0].contains("AcquisitionStart alone"), "{:?}", plan.remarks);
    let among = usual(&[("TriggerSelector", "TriggerSelector=AcquisitionStart,AcquisitionEnd")]);
    assert!(trouble(&among, &wishes()).contains("FrameStart"));
    let alone = short(&resolve(&usual(&[("TriggerSelector", "TriggerSelector=All")]), &wishes()));
    assert!(alone.contains("TriggerSelector=All TriggerMode=Off TriggerSource=Line0"), "{alone}");
    let lines =
        usual(&[("LineSelector", "LineSelector=Line0,Line1 LineMode=Output,Input LineInverter:bool")]);
    let plan = short(&resolve(&lines, &wishes()));
    assert!(
        plan.contains("LineSelector=Line0 LineMode=Input LineInverter=false TriggerSource=Line0"),
        "{plan}"
    );
    let text = trouble(&usual(&[("TriggerMode", "TriggerSoftware:cmd")]), &wishes());
    assert!(text.contains("no TriggerMode") && text.contains("left_to_settings"), "{text}");
}

#[test]
fn a_line_is_named_or_found_where_there_is_one_alone() {
    let sources = |entries: &str| usual(&[("TriggerSource", &format!("TriggerSource={entries}"))]);
    let line = |name: &str| stated(|words| words.trigger_line = Some(name.to_owned()));
    let plan = short(&resolve(&sources("Software,Line1,Line2"), &line("Line 2")));
    assert!(plan.contains("TriggerSource=Line2 "), "{plan}");
    assert!(short(&resolve(&sources("ExtTrig,SoftTrigger"), &wishes())).contains("TriggerSource=ExtTrig"));
    assert_eq!(
        trouble(&sources("Line1,Line2,Line3,Software"), &line("Line0")),
        "`Line0` is not an entry of TriggerSource: Line1, Line2, Line3, Software; set trigger_line = \"Line1\" or \
         another \
         of them, as the HSU is wired"
    );
    let text = trouble(&sources("Software,Line0,Line1"), &wishes());
    assert!(
        text.contains("several lines (Line0, Line1)") && text.contains("trigger_line = \"Line0\""),
        "{text}"
    );
    assert!(trouble(&sources("Software,Counter0"), &wishes()).contains("none of them is known as a line"));
    assert!(trouble(&sources("Software,Line0"), &line("Software")).contains("no wire"));
    // One that has no source takes its trigger from one place.
    let fixed = usual(&[("TriggerSource", "Width:int")]);
    assert!(!short(&resolve(&fixed, &wishes())).contains("TriggerSource"));
    assert!(trouble(&fixed, &line("Line0")).contains("trigger_line = \"auto\""));
}

#[test]
fn edges_and_overlap_are_set_by_the_cameras_names() {
    let falling = stated(|words| words.trigger_edge = Some(Edge::Falling));
    assert!(short(&resolve(&usual(&[]), &falling)).contains("TriggerActivation=FallingEdge"));
    let none = usual(&[("TriggerActivation", "TriggerActivation=None")]);
    let plan = resolve(&none, &wishes());
    assert!(plan.troubles.is_empty() && plan.remarks.join("; ").contains("TriggerActivation has None alone"));
    assert!(trouble(&none, &falling).contains("[\"TriggerActivation\", \"None\"]"));
    let mut left = wishes();
    left.words.left_to_settings = vec!["trigger_edge".to_owned()];
    assert!(!short(&resolve(&none, &left)).contains("TriggerActivation"), "it is left to the settings");
    assert!(trouble(&usual(&[("TriggerActivation", "Width:int")]), &falling).contains("rising"));
    for (has, expected) in [
        ("TriggerOverlap=Off,PreviousFrame,ReadOut", "TriggerOverlap=ReadOut"),
        ("TriggerOverlap=Off,PreviousFrame", "TriggerOverlap=PreviousFrame"),
        ("OverlapMode=Off,On", "OverlapMode=On"),
    ] {
        let made = usual(&[("TriggerOverlap", has)]);
        assert!(short(&resolve(&made, &wishes())).contains(expected), "{has}");
        let plain = stated(|words| words.overlap = Some(false));
        let off = format!("{}=Off", expected.split('=').next().expect("a name"));
        assert!(short(&resolve(&made, &plain)).contains(&off), "{has}");
    }
    assert!(
        trouble(&usual(&[("TriggerOverlap", "TriggerOverlap=Off")]), &wishes()).contains("overlap = false")
    );
    let fixed = usual(&[("TriggerOverlap", "TriggerOverlap=ReadOut!ro")]);
    assert!(short(&resolve(&fixed, &wishes())).contains("TriggerOverlap=ReadOut"), "looked at, and not set");
}

#[test]
fn images_that_are_not_grey_or_do_not_fit_are_refused_by_name() {
    for (has, expected) in
        [("PixelFormat=MONO_8,Mono12", "PixelFormat=MONO_8"), ("PixelFormat=Y8", "PixelFormat=Y8")]
    {
        assert!(short(&resolve(&usual(&[("PixelFormat", has)]), &wishes())).starts_with(expected), "{has}");
    }
    let text = trouble(&usual(&[("PixelFormat", "PixelFormat=BayerRG8,RGB8")]), &wishes());
    assert!(text.starts_with("`Mono8` is not an entry of PixelFormat: BayerRG8, RGB8"), "{text}");
    assert!(text.contains("set pixel = \"bayer8\""), "{text}");
    let text = trouble(&usual(&[("PixelFormat", "PixelFormat=YUV422,RGB8")]), &wishes());
    assert!(text.contains("use a camera that sends it"), "{text}");
    let old =
        usual(&[("PixelFormat", "PixelFormat=Mono8,Mono16!ro PixelCoding=Mono,Raw PixelSize=Bpp8,Bpp16")]);
    assert!(short(&resolve(&old, &wishes())).starts_with("PixelCoding=Mono PixelSize=Bpp8"));
    let fixed = |pixel| stated(|words| words.pixel = Some(pixel));
    let old = "PixelFormat=Mono8,Mono12Packed!ro PixelCoding=Mono,MonoPacked PixelSize=Bpp8,Bpp12";
    let plan = resolve(&usual(&[("PixelFormat", old)]), &fixed(Pixel::Mono12Packed));
    assert!(short(&plan).starts_with("PixelCoding=MonoPacked PixelSize=Bpp12"), "{}", short(&plan));
}

/// 8 bits where the camera has them, whatever else it has; else the fewest bytes whose rows end with one.
#[test]
fn deeper_grey_is_taken_where_it_is_named_or_where_there_is_no_8_bits() {
    let has = |entries: &str| usual(&[("PixelFormat", &format!("PixelFormat={entries}"))]);
    let chosen = |entries: &str, wishes: &Wishes| {
        resolve(&has(entries), wishes).pixel_format.map(|(entry, _)| entry).unwrap_or_default()
    };
    let auto = wishes();
    assert_eq!(chosen("Mono16,Mono12p,Mono8", &auto), "Mono8");
    assert_eq!(chosen("Mono16,Mono12,Mono12Packed,BayerRG8", &auto), "Mono12Packed");
    assert_eq!(chosen("Mono16,Mono12p,Mono10p", &auto), "Mono10p");
    assert_eq!(chosen("Mono16,Mono14", &auto), "Mono14");
    let odd = Wishes { size: (1922, 1200), ..wishes() };
    assert_eq!(chosen("Mono16,Mono12p,Mono10p", &odd), "Mono12p");
    let named = |pixel| stated(|words| words.pixel = Some(pixel));
    assert_eq!(chosen("Mono8,Mono12p", &named(Pixel::Mono12p)), "Mono12p");
    let text = trouble(&has("Mono8,Mono12p"), &named(Pixel::Mono16));
    assert!(text.contains("`Mono16` is not an entry of PixelFormat: Mono8, Mono12p; set pixel"), "{text}");
    let text = trouble(&has("Mono10p"), &Wishes { size: (1922, 1200), ..named(Pixel::Mono10p) });
    assert!(text.contains("needs rows of a multiple of 4 columns, and the rig has 1922"), "{text}");
    // A plane of a mosaic: whatever its filters are, and twice the columns and rows.
    let plane = Wishes { size: (960, 600), ..named(Pixel::Bayer8(Mosaic::RG)) };
    assert_eq!(chosen("Mono8,BayerGB8", &plane), "BayerGB8");
    let writes = short(&resolve(&has("Mono8,BayerGB8"), &plane));
    assert!(writes.contains("Width=1920 Height=1200"), "{writes}");
    assert!(trouble(&has("Mono8"), &plane).contains("`BayerRG8` is not an entry of PixelFormat: Mono8"));
    // Cameras that share a network leave room for frames as long as they are.
    let paced = |pixel| {
        let words =
            CameraWords { pixel: Some(pixel), packet_delay: Some(PacketDelay::Auto), ..wishes().words };
        let link = Link { cameras: 4, ..wishes().link };
        let made = [("PixelFormat", "PixelFormat=Mono8,Mono16"), ("GevSCPD", "StreamBytesPerSecond:int")];
        short(&resolve(&usual(&made), &Wishes { words, link, ..wishes() }))
    };
    assert!(paced(Pixel::Mono8).contains("StreamBytesPerSecond=322560012.9"), "{}", paced(Pixel::Mono8));
    assert!(paced(Pixel::Mono16).contains("StreamBytesPerSecond=645120025.8"), "{}", paced(Pixel::Mono16));
}

#[test]
fn packet_delays_are_counted_as_the_camera_counts() {
    let delay = |delay| stated(|words| words.packet_delay = Some(delay));
    let five = delay(PacketDelay::Microseconds(5.0));
    let with = |has: &str| usual(&[("GevSCPD", has)]);
    assert!(short(&resolve(&with("GevSCPD:int"), &five)).contains("GevSCPD=5us-in-ticks"));
    assert!(short(&resolve(&with("GevSCPD:int:ns"), &five)).contains("GevSCPD=5000"));
    assert!(trouble(&usual(&[]), &five).contains("time between two packets"));
    let mut shared = delay(PacketDelay::Auto);
    assert!(short(&resolve(&with("GevSCPD:int"), &shared)).contains("GevSCPD=0"), "a network of its own");
    shared.link.cameras = 4;
    let paced = short(&resolve(&usual(&[("GevSCPD", "StreamBytesPerSecond:int")]), &shared));
    assert!(paced.contains("StreamBytesPerSecond=322560012.9"), "{paced}");
    // 257 packets in nine tenths of 8.33 ms, three quarters of it for the others.
    assert!(short(&resolve(&with("GevSCPD:int"), &shared)).contains("GevSCPD=21.8us-in-ticks"));
    // At a low rate three packets at 1 Gbit/s are enough.
    shared.link.period_ns = 200_000_000;
    assert!(short(&resolve(&with("GevSCPD:int"), &shared)).contains("GevSCPD=216.9us-in-ticks"));
}

fn musts(text: &str) -> Vec<(String, String)> {
    let value = |want: &Want| match want {
        Want::Value(value) => value.to_string(),
        Want::Least => "least".to_owned(),
    };
    let (musts, troubles) = must_be(&made(text), &wishes());
    assert_eq!(troubles, []);
    musts.iter().map(|must| (must.feature.clone(), value(&must.want))).collect()
}

#[test]
fn what_spoils_images_must_be_off_whatever_its_spelling() {
    for (has, expected) in [
        ("ExposureAuto=Off,Continuous", "Off"),
        ("SharpeningAuto:bool", "false"),
        ("GammaEnabled:bool", "false"),
        ("Gamma:float", "1"),
        ("LUTEnable:bool", "false"),
        ("ReverseX:bool", "false"),
        ("BinningHorizontal:int", "1"),
        ("BinningVertical=X1,X2", "X1"),
        ("BinningHorizontal=Off,On", "Off"),
        ("DecimationVertical=DecimationVertical1,DecimationVertical2", "DecimationVertical1"),
        ("BinningMode=Binning1x1,Binning1x2", "Binning1x1"),
        ("SequencerMode=Off,On", "Off"),
        ("BoSequencerEnable=On,Off", "Off"),
        ("ChunkModeActive:bool", "false"),
        ("TestImageSelector=Off,Ramp", "Off"),
        ("TestPattern=Off,Ramp", "Off"),
        ("AcquisitionMode=SingleFrame,Continuous", "Continuous"),
        ("ExposureMode=Timed,TriggerWidth", "Timed"),
        ("AcquisitionFrameRateEnable:bool", "false"),
        ("AcquisitionFrameRateEnabled:bool", "false"),
        ("pgrHDRModeEnabled:bool", "false"),
        ("IMX174HardwareWDREnable:bool", "false"),
        ("TriggerDelay:float:us", "least"),
        ("ShutterMode=Rolling,Global", "Global"),
        ("AcquisitionFrameRateMode=On,Off", "Off"),
        ("mvAcquisitionFrameRateEnable=On,Off", "Off"),
        ("ExposureAuto=Manual,Continuous", "Manual"),
        ("DigitalShift:int", "0"),
    ] {
        let name = has.split([':', '=']).next().expect("a name").to_owned();
        assert_eq!(musts(has), [(name, expected.to_owned())], "{has}");
    }
    for harmless in
        ["Width:int", "LUTSelector=Luminance", "BinningHorizontalMode=Sum,Average", "ChunkEnable:bool"]
    {
        assert_eq!(musts(harmless), [], "{harmless}");
    }
    let (_, troubles) = must_be(&made("ExposureMode=TriggerWidth"), &wishes());
    assert!(troubles[0].to_string().contains("`Timed` is not an entry of ExposureMode"));
}
