/** A film of a view's day, which the service draws as an animation: request, progress and download. */

import { formatMoment } from '../moments';
import { type Service, ServiceError } from '../service';
import { settingsQuery } from '../shadow_settings';
import type { State } from '../state';
import type { Camera } from './camera';

/** Of the film, as the day is played. */
const FPS = 10;
/** Pixels of a frame, and of all frames, that services allow unless they are told otherwise. */
const MAX_FRAME_PX = 1920 * 1080;
const MAX_FILM_PX = 2 ** 27;
/** Seconds between two questions: progress is told at least as often. */
const MAX_POLL_S = 3;

/** What a view is: one of the level's, or a camera of somebody's own. */
export type FilmView = { readonly view: string } | { readonly camera: Camera };

/** The body of a request for an animation. */
export type FilmBody = Readonly<Record<string, unknown>>;

interface AnimationState {
  readonly jobID: string;
  readonly status: 'accepted' | 'running' | 'successful' | 'failed' | 'dismissed';
  readonly message: string;
  readonly frames: number;
  readonly frames_done: number;
}

/** Minutes between the frames of a film that can be chosen, and those of a new dialog. */
export const FILM_STEPS_MIN: readonly number[] = [2, 5, 10, 20, 30];
export const DEFAULT_FILM_STEP_MIN = 10;

/** The times of a film's frames, in even steps between the first and the last of `times`, both in minutes. */
export function filmTimes(times: readonly number[], stepMinutes: number): number[] {
  const [first = 0, last = first] = [times[0], times.at(-1)];
  return Array.from({ length: Math.floor((last - first) / stepMinutes) + 1 }, (_, index) => first + index * stepMinutes);
}

/** Width and height of a film in the proportions of `size`: no more pixels than services draw. */
export function filmSize([width, height]: readonly [number, number], frames: number): [number, number] {
  const scale = Math.min(1, Math.sqrt(Math.min(MAX_FRAME_PX, MAX_FILM_PX / frames) / (width * height)));
  return [Math.max(Math.floor(width * scale), 1), Math.max(Math.floor(height * scale), 1)];
}

/** What an animation is asked for: the times of a day, minutes by the clock of the state, in even steps. */
export function filmBody(state: State, shown: FilmView, size: readonly [number, number], steps: readonly number[]): FilmBody {
  const { date, offset, style } = state;
  const at = (minutes: number) => formatMoment({ date, offset, minutes });
  const [first = 0, second = first, last = second] = [steps[0], steps[1], steps.at(-1)];
  const [from, to] = [at(first), at(last)];
  const settings = Object.entries(settingsQuery(state)).map(([name, value]) => [name, typed(String(value))] as const);
  return {
    from, to, step: `${second - first || 1}m`, fps: FPS, size: filmSize(size, steps.length), ...(style ? { style } : {}), ...Object.fromEntries(settings),
    // A camera that rests is a path between two equal keys.
    ...('view' in shown ? shown : { path: { keys: [from, to].map((key) => ({ at: key, ...shown.camera })) } }),
  };
}

/** A text of the address as JSON has it: numbers and truth values are none there. */
function typed(text: string): string | number | boolean {
  if (text === 'true' || text === 'false') return text === 'true';
  return text.trim() !== '' && Number.isFinite(Number(text)) ? Number(text) : text;
}

/**
 * Has the service make a film; resolves with its address. `tell` hears how many frames are drawn, of how many. An abort dismisses
 * the film. Throws as `Service.request` does.
 */
export async function makeFilm(
  service: Service, level: string, body: FilmBody, tell: (done: number, all: number) => void, signal: AbortSignal,
): Promise<string> {
  let response = await service.request(service.of(level, 'animations'), {
    method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(body), signal,
  });
  let state = (await response.json()) as AnimationState;
  const address = service.address(`animations/${encodeURIComponent(state.jobID)}`);
  // Sent when the page goes away, too.
  const dismiss = () => void fetch(address, { method: 'DELETE', keepalive: true }).catch(() => {});
  signal.addEventListener('abort', dismiss, { once: true });
  if (signal.aborted) dismiss();
  try {
    while (state.status === 'accepted' || state.status === 'running') {
      tell(state.frames_done, state.frames);
      await pause(1000 * Math.min(Number(response.headers.get('Retry-After')) || 1, MAX_POLL_S), signal);
      response = await service.request(address, { signal });
      state = (await response.json()) as AnimationState;
    }
  } finally {
    signal.removeEventListener('abort', dismiss);
  }
  if (state.status !== 'successful') throw new ServiceError(state.message || 'The film was given up.', null);
  return `${address}/result`;
}

function pause(milliseconds: number, signal: AbortSignal): Promise<void> {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, milliseconds);
    signal.addEventListener('abort', () => {
      clearTimeout(timer);
      reject(new DOMException('aborted', 'AbortError'));
    }, { once: true });
  });
}
