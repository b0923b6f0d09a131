/** The camera of a view that a user makes, and its lines for a level file. */

export interface Camera {
  /** Longitude, latitude, metres above the ground there. */
  readonly eye: readonly [number, number, number];
  readonly target: readonly [number, number, number];
  /** Vertical field of view, degrees. */
  readonly fov: number;
}

/** Of eyes: as somebody stands. */
export const STANDING_M = 1.7;
export const FOV_DEG = 50;
/** Of pictures of views, as level files have it by default: width and height. */
export const VIEW_SIZE = [1280, 1024] as const;
const EARTH_RADIUS_M = 6_371_000;

export function positionText([lon, lat, height]: readonly [number, number, number]): string {
  return [digits(lon, 6), digits(lat, 6), digits(height, 1)].join(',');
}

export function parsePosition(text: string | undefined): [number, number, number] | null {
  const [lon = NaN, lat = NaN, height = NaN, ...more] = (text ?? '').split(',').map(Number);
  const right = [lon, lat, height].every(Number.isFinite) && Math.abs(lat) <= 90 && text !== '' && !more.length;
  return right ? [lon, lat, height] : null;
}

/** The view as a level file has it under `views:`. */
export function viewYaml({ eye, target, fov }: Camera, name: string): string {
  const list = (position: readonly [number, number, number]) => `[${positionText(position).replaceAll(',', ', ')}]`;
  return [
    'views:', `  ${keyOf(name)}:`, '    kind: perspective', `    eye: ${list(eye)}      # longitude, latitude, metres above the ground`,
    `    target: ${list(target)}`, `    fov: ${digits(fov, 2)}`, `    size: [${VIEW_SIZE.join(', ')}]`, '',
  ].join('\n');
}

/** Metres on the ground from eye to target. */
export function reach_m({ eye, target }: Camera): number {
  const [east, north] = offset_m(eye, target);
  return Math.hypot(east, north);
}

/** Degrees clockwise from north. */
export function bearing_deg({ eye, target }: Camera): number {
  const [east, north] = offset_m(eye, target);
  return ((Math.atan2(east, north) * 180) / Math.PI + 360) % 360;
}

/** What the view sees of the map: from the eye to as far as the target at either edge, [longitude, latitude] each, closed. */
export function wedge(camera: Camera): [number, number][] {
  const { eye } = camera;
  const [width, height] = VIEW_SIZE;
  const half = Math.atan((Math.tan((camera.fov * Math.PI) / 360) * width) / height);
  const middle = (bearing_deg(camera) * Math.PI) / 180;
  const reach = reach_m(camera);
  const edge: [number, number][] = [];
  for (let step = -8; step <= 8; step += 1) {
    const angle = middle + (half * step) / 8;
    edge.push(moved(eye, reach * Math.sin(angle), reach * Math.cos(angle)));
  }
  return [[eye[0], eye[1]], ...edge, [eye[0], eye[1]]];
}

function offset_m([lon, lat]: readonly [number, number, number], [toLon, toLat]: readonly [number, number, number]): [number, number] {
  const metre = (Math.PI / 180) * EARTH_RADIUS_M;
  return [(toLon - lon) * metre * Math.cos((lat * Math.PI) / 180), (toLat - lat) * metre];
}

function moved([lon, lat]: readonly [number, number, number], east: number, north: number): [number, number] {
  const metre = (Math.PI / 180) * EARTH_RADIUS_M;
  return [lon + east / (metre * Math.cos((lat * Math.PI) / 180)), lat + north / metre];
}

/** A number without digits that say nothing. */
function digits(value: number, most: number): string {
  return String(Number(value.toFixed(most)));
}

/** A name that YAML reads as a key as it stands. */
function keyOf(name: string): string {
  return /^[A-Za-z][\w-]*$/.test(name) && !/^(true|false|yes|no|on|off|null|y|n)$/i.test(name) ? name : JSON.stringify(name || 'my_view');
}
