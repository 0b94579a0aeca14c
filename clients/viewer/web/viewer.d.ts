// What the viewer says beside the wire: its messages, its own methods' answers, and what the
// page makes of them.
import type {
  CalibrationFitResult,
  CheckStep,
  DatasetInfo,
  DatasetListResult,
  DatasetResult,
  Estimated,
  GeometryState,
  HelloResult,
  ImageFlags,
  ImageOrigin,
  JobStatus,
  Mark,
  Methods,
  State,
} from "./wire.js";

import type { Moment } from "../data/moment.js";

export type * from "./wire.js";

export type Pair = [number, number];
export type Four = [number, number, number, number];
export type Vector = [number, number, number];
export type Kind = "line_integral" | "counts";
export type View = "iso" | "beam" | "side" | "free";

// What quantities are compared by.
export type Value = string | number | boolean | null | readonly Value[];

export interface Camera {
  position: Vector;
  look_at: Vector;
  fov: number;
}
// Where the beam's frame goes, in parts of the detector's width and height.
export interface Framing {
  width: number;
  height: number;
  left: number;
  top: number;
  aspect: number;
  exact: boolean;
  sample_height_mm: number;
}
export interface Near {
  mm: number | null;
  pair: string[];
  close: boolean;
}

// A recorded image, and what cannot be said of it.
export interface AboutImage {
  name: string;
  index: number;
  file: string;
  image: "dark" | "flat" | "projection";
  projection: number | null;
  time_s: number | null;
  positions: Record<string, number> | null;
  problem: string;
  // Share of its scan's pixels, as predicted; null where nothing predicted it.
  saturated: number | null;
  geometry: GeometryState | null;
  tube: { kV: number | null; power_W: number | null; on: boolean } | null;
  virtual_origin?: ImageOrigin | null;
}
export interface ImageHead {
  kind: Kind;
  code: "jpeg" | "deflate";
  shape: Pair;
  pair: boolean;
  full: Pair;
  low: number;
  scale: number;
  time: number;
  cone_vec: number[];
  seq: number;
  flags: ImageFlags | null;
  origin: ImageOrigin | null;
  twin: string;
  window: Pair;
  beads: Pair[];
  at: number;
  recorded?: AboutImage;
}
// An image as the page shows it: `signed` is a difference `of` one image `from` the pixels of
// another.
export interface Shown extends ImageHead {
  pixels: Uint16Array;
  virtual?: Uint16Array;
  at_ms: number;
  signed?: boolean;
  of?: Shown;
  from?: Uint16Array | number;
}

// A volume as a page has it: codes [z][y][x], 0 where no data cover, from 1 for `low` to 65535
// for `high`; of cubes of `factor` voxels a side.
export interface BlockHead {
  shape: Vector;
  factor: number;
  low: number;
  high: number;
  window: Pair;
}
export interface Block extends BlockHead {
  codes: Uint16Array<ArrayBuffer>;
  voxel_mm: number;
  signed?: boolean;
  own?: boolean;
}
export type Name = NonNullable<Requests["viewer.block"]["what"]>;
// As measured and as true [1/mm, part, mm], and the rms difference.
export interface Figures {
  attenuation: Pair;
  void: Pair;
  x_mm: Pair;
  y_mm: Pair;
  z_mm: Pair;
  rms: number;
}
export interface LogEntry {
  level: string;
  message: string;
  data?: { about?: string };
}

export interface VolumeMessage {
  name: string;
  side: number;
  past: boolean;
  // What it is compared with the stage by; no offset where its data set does not say.
  made?: {
    sample: string;
    revision: string | null;
    material: string | null;
    offset: State["sample"]["offset"] | null;
    correction: string | null;
  };
  problem?: string;
  views?: number;
  of?: number;
  size?: Vector;
  voxel_mm?: number;
  // Of a finished one: how much of the work is done, and then what it was made of.
  done?: number;
  phase?: string;
  binning?: number;
  geometry?: string;
  doubts?: string[];
  details?: string;
  volumes?: Name[];
  uncovered?: number;
  // Share of the scan's pixels, as predicted; null where nothing predicted it.
  saturated?: number | null;
  sample?: string;
  started?: string;
  kV?: number | null;
  comparing?: number;
  compared?: Record<string, Figures>;
  not_compared?: string;
}
interface Failure {
  code: number;
  message: string;
  data?: unknown;
}
// Messages by their type.
export interface Messages {
  answer: { id: number; result: unknown; error?: Failure };
  state: {
    state: State;
    framing: Framing;
    // Diameter of the cylinder about its z axis that holds the sample.
    across_mm: number | null;
    near: Near;
    cone_vec: number[];
    at: number;
  };
  link: {
    connected: boolean;
    problem: string | null;
    drawn: boolean;
    twin: string;
    hello: HelloResult | null;
  };
  session: { connected: boolean; session: string | null };
  volume: VolumeMessage;
  layers: { shown: Record<string, boolean>; opacity: number };
  job: { data: JobStatus };
  note: { level: string; title: string; body: string };
  log: { data: LogEntry };
  beat: { at: number; silent_s: number };
  // Where a handle is dragged to: why that cannot be reached, or how long it takes (twin's clock).
  drag: { targets: Record<string, number>; why: string | null; duration_s: number | null };
  // Boxes of what a view's picture is about: source, sample and image.
  subject: { view: View; boxes: Four[] };
  // What was clicked in a scene, and the motor nearest to it.
  part: { part: string; motor: string | null };
}

export interface Offer {
  url: string;
  name: string;
  bytes: number;
}
export interface PlanDocument {
  duration_s: number;
  frames: number;
  bytes: number;
  times: number[];
  curves: Record<string, number[]>;
  images: Array<[number, string]>;
  steps: CheckStep[];
}
export interface TrackedFrame {
  file: string;
  measured: Array<Pair | null>;
  before: Array<Pair | null>;
  after: Array<Pair | null> | null;
}
export interface TrackedScan {
  dataset: string;
  folder: string;
  before: string;
  rms_before_px: number | null;
  rms_after_px: number | null;
  frames: TrackedFrame[];
}
// What `flexdt calibrate --json` writes beside what the wire names.
export interface FitReport extends Omit<CalibrationFitResult, "tracks"> {
  verdict: string;
  next: string[];
  image_space?: Array<Record<string, Pick<Estimated, "value" | "sigma" | "unit">>>;
  outliers: Array<{ frame: number; marker: number; px: number | null }>;
  frames: number;
  cost_reduction_pct: number | null;
  weak: string[];
  tracks: { phantom: string; datasets: TrackedScan[] } | null;
}

export type Requests = { [M in keyof Methods]: Methods[M][0] };
type WireAnswers = { [M in keyof Methods]: Methods[M][1] };
// The viewer's own methods answer with nothing, unless they are named here.
export interface Answers extends WireAnswers {
  "calibration.fit": FitReport;
  "viewer.ray": { paths_mm: Record<string, number>; length_mm: number };
  "viewer.preset": Partial<Camera>;
  "viewer.spectrum": {
    energy_keV: number[];
    photons: number[];
    mean_keV: number;
    filters: Array<{ material: string; thickness_mm: number }>;
    limits: { kV: Pair; power_W: Pair; exposure_ms: Pair };
  };
  "viewer.plan": PlanDocument;
  "viewer.recorded": DatasetResult;
  "viewer.recorded_image": AboutImage;
  "viewer.thumbnail": {
    name: string;
    index: number;
    file: string;
    image: { shape: Pair; data: string };
  };
  "viewer.block": Partial<BlockHead & Offer>;
  "viewer.voxel": Record<string, number | null>;
  "viewer.compose": { text: string; moved: Record<string, Pair> };
  "viewer.datasets": Omit<DatasetListResult, "datasets"> & {
    // None of `beads` is known of samples that do not ship.
    datasets: Array<DatasetInfo & { beads: boolean | null }>;
  };
  "viewer.scrub": { positions: Record<string, number> | null };
  "viewer.screenshot": Offer;
  "viewer.export": Offer;
}

// What the parts of the page tell each other: event -> what comes with it.
export interface Events {
  // A note replaces one about the same subject, and goes when that is settled.
  note: [level: string, title: string, body?: string, about?: string];
  settled: [about: string];
  connection: [];
  open: [];
  session: [];
  layers: [];
  age: [];
  compare: [];
  design: [];
  samples: [];
  state: [state: State];
  job: [job: JobStatus];
  scan: [fresh: boolean];
  volume: [volume: VolumeMessage];
  image: [image?: Shown | null];
  log: [entry: LogEntry];
  tab: [name: string];
  drag: [told: Messages["drag"]];
  said: [];
  part: [part: string, motor: string | null];
  subject: [view: View, boxes: Four[]];
  "show-tab": [name: string];
  moment: [moment: Moment];
  recorded: [name: string | null];
  frame: [target: Window];
  calibrate: [dataset: string, sample: string, markers?: Mark[]];
  align: [dataset: string];
  reconstruct: [dataset: string];
  script: [text: string];
}

declare global {
  // What is read is not known: a cast says what it should be.
  interface JSON {
    parse(text: string): unknown;
  }
  interface Window {
    pageId: string;
    flexdt: unknown;
    firstView: string;
    still: (
      image: HTMLImageElement,
      view: string,
      size: { clientWidth: number; clientHeight: number },
    ) => void;
  }
}
