// Written by tests/viewer/test_page_source.py from the OpenRPC document of the wire and of the
// viewer's own methods: the methods that the page calls, and the types and fields that it names.
// Answers have all their fields; what a request may leave out bears a "?".
export type AxisState = {
  position: number; target: number; velocity: number; limits: [number, number]; moving: boolean;
  unit: "mm" | "deg"; speed: number | null; virtual: boolean
};
export type Block = {
  name?: string | null; side?: 128 | 192 | 256 | 512; past?: boolean;
  what?: "volume" | "sigma" | "bias_bound" | "truth" | "difference" | "other"
};
export type CalibrationAlign = { name: string };
export type CalibrationAlignResult = {
  identifiable: boolean; parameters: Record<string, Estimated>; refused: Record<string, string>;
  warnings: Array<string>; correction: Record<string, number> | null;
  motion: Array<Record<string, JsonValue>> | null
};
export type CalibrationDelete = { name: string };
export type CalibrationFit = {
  datasets: Array<string>; phantom: string; free?: Array<string> | null; steps?: number;
  tracks?: boolean; markers?: Array<Mark> | null; scale?: string | null
};
export type CalibrationFitResult = {
  identifiable: boolean; parameters: Record<string, Estimated>;
  correction: Record<string, number> | null; rms_px: number | null; steps: Array<CalibrationStep>;
  tracks: Record<string, JsonValue> | null; problems: Array<CalibrationProblem>
};
export type CalibrationProblem = { code: string; severity: "error" | "warning"; text: string };
export type CalibrationStep = { frames: number };
export type Camera = { view?: "iso" | "beam" | "side" | "free"; sample?: boolean };
export type CameraPart = {
  mode: string; roi: [number, number, number, number]; exposure_ms: number; averages: number;
  frames: number
};
export type CameraSet = {
  exposure_ms?: number | null; mode?: string | null; roi?: [number, number, number, number] | null;
  averages?: number | null; frames?: number | null
};
export type CameraState = {
  mode: string; exposure_ms: number; roi: [number, number, number, number]; averages: number;
  frames: number; shape: [number, number]; pixel_mm: number
};
export type CheckCollision = { line: number | null; time_s: number; pair: Array<string> };
export type CheckResult = {
  ok: boolean; problems: Array<Problem>; steps: Array<CheckStep>; duration_s: number;
  frames: number; bytes: number; collisions: Array<CheckCollision>; min_clearance_mm: number | null;
  min_clearance_pair: Array<string> | null
};
export type CheckStep = {
  line: number | null; start_s: number; duration_s: number; what: string
};
export type ClockState = {
  time_s: number; speed_up: number | "max"; real_time_factor: number | null
};
export type Compose = {
  kind?: "fly" | "step" | "tiled" | "helical" | "calibration"; frames: number; exposure_ms?: number;
  kV?: number | null; power_W?: number | null; voxel_um?: number | null; keep?: Array<string>
};
export type Control = { action: "acquire" | "release" | "force" };
export type ControlResult = { controller: string | null; yours: boolean };
export type Correct = {
  parameters: Record<string, number>; name?: string | null; comment?: string;
  source?: string | null; sides_known?: boolean
};
export type Correction = {
  name: string; date: string; parameters: Record<string, number>; comment: string;
  source: string | null; sides_known: boolean
};
export type CorrectionDeleted = { name: string };
export type CorrectionListResult = { corrections: Array<Correction>; current: string | null };
export type CorrectionPart = {
  name: string; date: string; parameters: Record<string, number>; comment?: string;
  sides_known?: boolean
};
export type CorrectionResult = { correction: Correction | null; warnings: Array<string> };
export type Covered = {
  view: "iso" | "beam" | "side" | "free"; boxes: Array<[number, number, number, number]>
};
export type DatasetGet = {
  name: string; points?: number; measure?: boolean; script?: boolean
};
export type DatasetInfo = {
  name: string; modified: number; started: string | null; duration_s: number | null;
  state: "complete" | "incomplete" | "running" | "unknown"; reason: string; projections: number;
  present: number; machine: string | null; sample: string; kV: number | null;
  power_W: number | null; exposure_ms: number | null; mode: string | null;
  shape: [number, number] | null; saturated: number | null; problem: string;
  thumbnail: ImageValue | null
};
export type DatasetListResult = {
  datasets: Array<DatasetInfo>; total: number; unread: number; left_out: number
};
export type DatasetResult = {
  info: DatasetInfo; made: ScannedSample; images: number; indices: Array<number>;
  files: Array<string>; kinds: Array<"dark" | "flat" | "projection">; present: Array<boolean>;
  times_s: Array<number> | null; positions: Record<string, Array<number | null>>;
  same_machine: boolean; counts: Array<number | null> | null;
  clearance_mm: Array<number | null> | null; clearance_of: string; script: string | null;
  warnings: Array<string>; provenance: Array<StatedValue>
};
export type Datasets = { search?: string; start?: number };
export type Empty = Record<string, never>;
export type Estimated = { value: number | null; sigma: number | null; unit: string };
export type Export = { format?: "html" | "viser"; replay?: boolean };
export type ExposurePredict = {
  sample?: string | null; kV?: number | null; power_W?: number | null; filter?: string;
  exposure_ms?: number | null; averages?: number | null; mode?: string | null;
  roi?: [number, number, number, number] | null; frames?: number;
  kind?: "fly" | "step" | "tiled" | "helical" | "calibration" | null; sod_mm?: number | null;
  sdd_mm?: number | null; detail?: string
};
export type ExposurePrediction = {
  sample: string; transmission: TransmissionShares; saturated: number; starved: number;
  detail: string; asked: PredictedSetting; best: Array<PredictedSetting>; frames: number;
  seconds: number; bytes: number; assumed: Array<string>
};
export type Feed = { kind: "line_integral" | "counts" };
export type GeometryState = {
  SOD_mm: number; SDD_mm: number; magnification: number; voxel_size_mm: number;
  piercing_point_px: [number, number]; field_of_view_mm: [number, number];
  cone_angle_deg: number | null; axis_column_px: number | null
};
export type Ghost = { shown: boolean };
export type HelloResult = {
  protocol: string; server: string; machine: string; profile: string | null; session: string | null;
  physics: string | null; rays: number | "auto" | null; instance: string | null
};
export type ImageFlags = {
  time: number | null; saturated: number; starved: number; good_counts: [number, number] | null;
  good_lines: [number, number] | null
};
export type ImageOrigin = {
  sample: string | null; revision: string | null; material: string | null; offset: SamplePlacement;
  lit: boolean; kV: number; power_W: number; mode: string; exposure_ms: number; averages: number;
  roi: [number, number, number, number]; correction: string | null; dataset: string | null;
  index: number | null; file: string | null
};
export type ImageValue = { shape: Array<number>; data: string };
export type JobAbort = { job?: string | null; reason?: string | null };
export type JobForget = { job?: string | null };
export type JobForgetResult = { jobs: Array<string> };
export type JobList = { start?: number; count?: number | null };
export type JobListResult = { jobs: Array<JobStatus>; total: number | null };
export type JobRef = { job?: string | null };
export type JobStatus = {
  job: string;
  state: "queued" | "running" | "paused" | "done" | "failed" | "aborted" | "incomplete";
  name: string; dataset: string | null; frames_done: number; frames_total: number;
  elapsed_s: number; remaining_s: number | null; time: number; speed_up: number | "max";
  real_time_factor: number | null; error: Record<string, unknown> | null; warnings: Array<string>;
  step: number | null; line: number | null; what: string; ended_by: string | null;
  start: Record<string, number> | null
};
export type Jog = { axis: string; velocity: number; lease_s?: number };
export type JsonValue = unknown;
export type Layers = {
  beam?: boolean | null; panel?: boolean | null; axis?: boolean | null; ranges?: boolean | null;
  margin?: boolean | null; sample?: boolean | null; machine?: boolean | null;
  names?: boolean | null; labels?: boolean | null; opacity?: number | null
};
export type Live = {
  name?: string | null; side?: 128 | 192 | 256 | 512; past?: boolean
};
export type Mark = {
  frame: number; marker: string; column: number; row: number; sigma?: number | null
};
export type Move = {
  targets: Record<string, number>; relative?: boolean; wait?: boolean; plan?: boolean
};
export type MoveResult = {
  duration_s: number; warnings: Array<string>; moves: Array<Record<string, number>> | null;
  arrived: boolean | null
};
export type Person = { name?: string };
export type Placement = {
  x?: number; y?: number; z?: number; rx?: number; ry?: number; rz?: number
};
export type Plan = { text?: string | null };
export type PredictedSetting = {
  kV: number; filter: string; exposure_ms: number; averages: number; cnr: number | null;
  kerma_mGy: number
};
export type Preset = { view?: "iso" | "beam" | "side" | "free"; aspect?: number };
export type Problem = {
  severity: "error" | "warning"; code: string; line: number | null; column: number | null;
  message: string
};
export type Ray = { pixel?: [number, number] | null };
export type Recorded = { name?: string | null };
export type RecordedImage = {
  index: number; kind?: "line_integral" | "counts"; virtual?: boolean
};
export type Reset = { stop?: number | null };
export type SafetyState = {
  state: string; estop: boolean; message: string; stop: number; stopped_by: string | null;
  clearance_mm: number | null; pair: Array<string> | null; warnings: Array<string>
};
export type SampleDelete = { name: string };
export type SampleDeleteResult = { name: string; bytes: number };
export type SampleInfo = {
  name: string; kind: "phantom" | "mesh" | "voxels" | "scene"; description: string;
  size_mm: [number, number, number] | null; uploaded: boolean
};
export type SampleList = { start?: number; count?: number | null };
export type SampleListResult = {
  samples: Array<SampleInfo>; total: number | null; materials: Array<string>
};
export type SamplePart = {
  name: "" | string; material?: string | null; offset?: Placement
};
export type SamplePlacement = {
  x: number; y: number; z: number; rx: number; ry: number; rz: number
};
export type SampleResult = { sample: SampleState; warnings: Array<string> };
export type SampleSet = {
  name?: string | null; file?: string | null; material?: string | null; offset?: Placement | null
};
export type SampleState = {
  name: string | null; material: string | null; offset: SamplePlacement;
  size_mm: [number, number, number] | null; description: string; revision: string | null
};
export type SampleUpload = {
  name: string; kind?: "mesh" | "voxels" | "scene";
  format: "stl" | "obj" | "ply" | "glb" | "off" | "raw" | "json" | "toml"; total: number;
  start?: number; data: string; unit?: "um" | "mm" | "cm" | "m" | "inch" | null;
  place?: "keep" | "centred" | null; material?: string | null;
  shape?: [number, number, number] | null; voxel_mm?: [number, number, number] | null
};
export type ScannedSample = {
  sample: string; revision: string | null; material: string | null; offset: SamplePlacement | null;
  correction: string | null
};
export type Scene = {
  schema: 1; flexdt?: string; name?: string; saved?: string; machine: string; profile: string;
  positions: Record<string, number>; tube: TubePart; camera: CameraPart; sample: SamplePart;
  correction?: CorrectionPart | null
};
export type SceneLoad = { document: Scene };
export type SceneLoaded = {
  time: number; axes: Record<string, AxisState>; tube: TubeState; camera: CameraState;
  sample: SampleState; geometry: GeometryState | null; safety: SafetyState; job: JobStatus | null;
  correction: Correction | null; clock: ClockState; controller: string | null;
  image: ImageFlags | null; unsaved: string | null; projector: string | null;
  missing: Record<string, string>; warnings: Array<string>
};
export type SceneResult = { document: Record<string, JsonValue> };
export type SceneSave = { name?: string | null };
export type Screenshot = {
  view?: "iso" | "beam" | "side" | "free"; width?: number; height?: number
};
export type ScriptInput = {
  text?: string | null; name?: string | null; speed_up?: number | "max" | null
};
export type Scrub = { time_s?: number | null };
export type Spectrum = { kV: number };
export type State = {
  time: number; axes: Record<string, AxisState>; tube: TubeState; camera: CameraState;
  sample: SampleState; geometry: GeometryState | null; safety: SafetyState; job: JobStatus | null;
  correction: Correction | null; clock: ClockState; controller: string | null;
  image: ImageFlags | null; unsaved: string | null; projector: string | null;
  missing: Record<string, string>
};
export type StatedValue = {
  field: string; value: string; use: "used" | "contradicted" | "ignored"; consequence: string
};
export type Stopped = {
  time: number; axes: Record<string, AxisState>; tube: TubeState; camera: CameraState;
  sample: SampleState; geometry: GeometryState | null; safety: SafetyState; job: JobStatus | null;
  correction: Correction | null; clock: ClockState; controller: string | null;
  image: ImageFlags | null; unsaved: string | null; projector: string | null;
  missing: Record<string, string>
};
export type SubmitResult = {
  job: string; dataset: string | null; warnings: Array<string>
};
export type Theme = { dark?: boolean; fine?: boolean };
export type Thumbnail = { name: string; index: number; side?: number };
export type TransmissionShares = {
  least: number; p1: number; edges: Array<number>; shares: Array<number>
};
export type TubePart = { kV: number; power_W: number; on?: boolean };
export type TubeSet = {
  kV?: number | null; power_W?: number | null; on?: boolean | null
};
export type TubeState = {
  on: boolean; kV: number; power_W: number; ready: boolean; ready_in_s: number | null
};
export type UploadResult = {
  name: string; received: number; complete: boolean; sample: SampleInfo | null;
  warnings: Array<string>
};
export type Voxel = {
  name?: string | null; side?: 128 | 192 | 256 | 512; past?: boolean; at: Array<number>
};
export type Window = { low?: number | null; high?: number | null };

// Method -> its parameters, and its answer where the wire names one.
export interface Methods {
  "session.control": [Control, ControlResult];
  "state.get": [Empty, State];
  "axes.move": [Move, MoveResult];
  "axes.jog": [Jog, MoveResult];
  "axes.stop": [Empty, Stopped];
  "safety.estop": [Empty, Stopped];
  "safety.reset": [Reset, State];
  "tube.set": [TubeSet, TubeState];
  "camera.set": [CameraSet, CameraState];
  "sample.set": [SampleSet, SampleResult];
  "sample.list": [SampleList, SampleListResult];
  "sample.upload": [SampleUpload, UploadResult];
  "sample.delete": [SampleDelete, SampleDeleteResult];
  "exposure.predict": [ExposurePredict, ExposurePrediction];
  "script.check": [ScriptInput, CheckResult];
  "script.submit": [ScriptInput, SubmitResult];
  "job.status": [JobRef, JobStatus];
  "job.pause": [JobRef, JobStatus];
  "job.resume": [JobRef, JobStatus];
  "job.step": [JobRef, JobStatus];
  "job.abort": [JobAbort, JobStatus];
  "job.list": [JobList, JobListResult];
  "job.forget": [JobForget, JobForgetResult];
  "dataset.get": [DatasetGet, DatasetResult];
  "calibration.apply": [Correct, CorrectionResult];
  "calibration.list": [Empty, CorrectionListResult];
  "calibration.revert": [Empty, CorrectionResult];
  "calibration.delete": [CalibrationDelete, CorrectionDeleted];
  "calibration.fit": [CalibrationFit, CalibrationFitResult];
  "calibration.align": [CalibrationAlign, CalibrationAlignResult];
  "scene.save": [SceneSave, SceneResult];
  "scene.load": [SceneLoad, SceneLoaded];
  "viewer.layers": [Layers, object];
  "viewer.person": [Person, object];
  "viewer.theme": [Theme, object];
  "viewer.camera": [Camera, object];
  "viewer.covered": [Covered, object];
  "viewer.preset": [Preset, object];
  "viewer.feed": [Feed, object];
  "viewer.window": [Window, object];
  "viewer.ray": [Ray, object];
  "viewer.spectrum": [Spectrum, object];
  "viewer.plan": [Plan, object];
  "viewer.recorded": [Recorded, object];
  "viewer.recorded_image": [RecordedImage, object];
  "viewer.thumbnail": [Thumbnail, object];
  "viewer.live": [Live, object];
  "viewer.ghost": [Ghost, object];
  "viewer.block": [Block, object];
  "viewer.voxel": [Voxel, object];
  "viewer.compare": [Live, object];
  "viewer.compose": [Compose, object];
  "viewer.datasets": [Datasets, object];
  "viewer.scrub": [Scrub, object];
  "viewer.screenshot": [Screenshot, object];
  "viewer.export": [Export, object];
}
