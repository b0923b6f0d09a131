/**
 * Plays a day: the sun goes from its rise to its set, and the map with it.
 *
 * The pictures lie on the map as one canvas above the layer. It changes only when the next picture is there whole, so no frame is
 * blank, however slow the service is; what has been seen runs at full speed.
 */

import type { CanvasSource } from 'maplibre-gl';

import { type FrameProgress, type Frames, type Range, cornersOf, rangeOver, tilesOfEach } from './frames';
import { LAYER, type LevelMap } from './map';
import { DAY_MINUTES } from './moments';
import { pictureQuery } from './query';
import { type PlacedLevel, type Service, type SunPlace, inWords, isAbort } from './service';
import type { State, Store } from './state';
import type { SunDay } from './sun_day';

const CANVAS = 'frames';
const STEP_MIN = 10;
const LAST_STEP = DAY_MINUTES / STEP_MIN - 1;
/** Ten steps a second, and for people who want little motion one, without fading. */
const STEP_MS = 100;
const CALM_STEP_MS = 1000;
const TOLD_MS = 250;
/** So many pictures ahead are wanted, of which so many are asked for at a time. */
const AHEAD = 12;
const AT_ONCE = 2;

export interface Played {
  readonly minutes: number;
  /** The service's; null where it does not say. */
  readonly sun: SunPlace | null;
}

/** What playing waits for: the picture of a time, of tiles; so many pictures of the day are there. */
export interface DayWait {
  readonly minutes: number;
  readonly tiles: FrameProgress | null;
  readonly ready: number;
  readonly all: number;
}

export interface PlayerNews {
  /** The player shows a step. */
  step(played: Played): void;
  /** It waits for a picture, and how far that is; null: it no longer waits. */
  waiting(wait: DayWait | null): void;
  failed(words: string): void;
  /** It has begun or ended. */
  playing(plays: boolean): void;
}

export class Player {
  readonly #canvas = document.createElement('canvas');
  readonly #suns = new Map<string, SunPlace | null>();
  #ending: AbortController | null = null;
  #range: Range | null = null;
  #shown: HTMLCanvasElement | null = null;
  #fetching = false;
  /** Tiles of a picture, and milliseconds that the last frame took. */
  #most = tilesOfEach(1);
  #frameMs = 0;

  constructor(
    private readonly shown: LevelMap,
    private readonly frames: Frames,
    private readonly service: Service,
    private readonly store: Store,
    private readonly level: () => PlacedLevel,
    private readonly still: boolean,
    private readonly news: PlayerNews,
  ) {}

  get plays(): boolean {
    return this.#ending !== null;
  }

  /** Ends playing; the canvas stays until `clear`, when the map below shows the same time. */
  stop(): void {
    this.#ending?.abort();
    this.#ending = null;
  }

  clear(): void {
    if (this.plays) return;
    if (this.shown.map.getLayer(CANVAS)) this.shown.map.removeLayer(CANVAS);
    if (this.shown.map.getSource(CANVAS)) this.shown.map.removeSource(CANVAS);
    this.#range = null;
    this.shown.setOpacity(this.store.state.opacity);
  }

  /** Plays a day round and round until `stop`, from the present time on if the sun is up then. */
  async play(day: SunDay): Promise<void> {
    this.stop();
    const ending = new AbortController();
    this.#ending = ending;
    this.news.playing(true);
    const steps = stepsOf(day);
    this.#most = tilesOfEach(steps.length);
    let wrong = '';
    let at = Math.max(0, steps.findIndex((minutes) => minutes >= this.store.state.minutes));
    try {
      for (let fresh = true; !ending.signal.aborted; fresh = false) {
        const minutes = steps[at] ?? 0;
        const picture = await this.#next(steps, at, ending.signal);
        await this.#whenSeen(ending.signal);
        await this.#fadeTo(picture, fresh || at === 0, ending.signal);
        if (ending.signal.aborted) break;
        this.news.step({ minutes, sun: this.#suns.get(this.#template(minutes)) ?? null });
        at = (at + 1) % steps.length;
      }
    } catch (error) {
      if (!isAbort(error)) wrong = inWords(error);
    } finally {
      if (this.#ending === ending) this.#ending = null;
      this.news.waiting(null);
      if (!this.plays) {
        // A canvas that may change keeps the map from coming to rest.
        this.shown.map.getSource<CanvasSource>(CANVAS)?.pause();
        this.news.playing(false);
        if (wrong) this.news.failed(wrong);
      }
    }
  }

  /** The picture of a step, for what is seen now; more are asked for ahead meanwhile. */
  async #next(steps: readonly number[], at: number, signal: AbortSignal): Promise<HTMLCanvasElement> {
    for (;;) {
      const range = this.#rangeSeen();
      const template = this.#template(steps[at] ?? 0);
      // The picture that is wanted now is asked for before those that come after it.
      const picture = this.frames.get(template, range) ?? this.#waitFor(steps, at, range, signal);
      void this.#fetchAhead(steps, at, range, signal);
      const whole = await picture;
      // Somebody may have moved the map meanwhile.
      if (same(range, this.#rangeSeen())) {
        this.#lay(range);
        return whole;
      }
    }
  }

  /** Loads a picture, and tells how far it is meanwhile. */
  async #waitFor(steps: readonly number[], at: number, range: Range, signal: AbortSignal): Promise<HTMLCanvasElement> {
    const minutes = steps[at] ?? 0;
    const template = this.#template(minutes);
    const tell = () => this.news.waiting({
      minutes, tiles: this.frames.progress(template, range) ?? null, all: steps.length,
      ready: steps.filter((each) => this.frames.get(this.#template(each), range)).length,
    });
    tell();
    const telling = setInterval(tell, TOLD_MS);
    try {
      return await this.#load(minutes, range, signal);
    } finally {
      clearInterval(telling);
      this.news.waiting(null);
    }
  }

  async #fetchAhead(steps: readonly number[], at: number, range: Range, signal: AbortSignal): Promise<void> {
    if (this.#fetching) return;
    this.#fetching = true;
    try {
      const wanted = Array.from({ length: Math.min(AHEAD, steps.length - 1) }, (_, ahead) => steps[(at + 1 + ahead) % steps.length] ?? 0)
        .filter((minutes) => !this.frames.get(this.#template(minutes), range));
      const lanes = Array.from({ length: AT_ONCE }, async () => {
        for (let minutes = wanted.shift(); minutes !== undefined && !signal.aborted; minutes = wanted.shift()) {
          if (!same(range, this.#rangeSeen())) return;
          await this.#load(minutes, range, signal);
        }
      });
      await Promise.all(lanes);
    } catch {
      // The step that needs it asks again, and tells of it.
    } finally {
      this.#fetching = false;
    }
  }

  async #load(minutes: number, range: Range, signal: AbortSignal): Promise<HTMLCanvasElement> {
    const template = this.#template(minutes);
    const sun = this.#suns.has(template) ? null : this.service.tileJson(this.level().name, this.#query(minutes), signal)
      .then(({ skugga }) => this.#suns.set(template, skugga.sun));
    const [picture] = await Promise.all([this.frames.load(template, range, signal), sun]);
    return picture;
  }

  #query(minutes: number) {
    const state: State = { ...this.store.state, minutes, sunBy: 'time' };
    return pictureQuery(state);
  }

  #template(minutes: number): string {
    return this.service.tiles(this.level().name, this.#query(minutes));
  }

  #rangeSeen(): Range {
    const { map } = this.shown;
    const [seen, level] = [map.getBounds(), this.level()];
    const range = rangeOver(
      [seen.getWest(), seen.getSouth(), seen.getEast(), seen.getNorth()], level.bounds, this.shown.tileZoom(level), level.minzoom, this.#most,
    );
    // Nothing of the level is seen: what was seen last goes on.
    return range ?? this.#range ?? (rangeOver(level.bounds, level.bounds, level.minzoom, level.minzoom) as Range);
  }

  /** Puts the canvas over the tiles of a range; it is painted before anybody sees it. */
  #lay(range: Range): void {
    if (this.#range && same(range, this.#range)) return;
    const { map } = this.shown;
    const before = this.#shown && this.#range ? { picture: this.#shown, range: this.#range } : null;
    this.#range = range;
    this.#shown = null;
    const size = before?.range;
    if (!size || size.cols !== range.cols || size.rows !== range.rows || !map.getSource(CANVAS)) {
      if (map.getLayer(CANVAS)) map.removeLayer(CANVAS);
      if (map.getSource(CANVAS)) map.removeSource(CANVAS);
      Object.assign(this.#canvas, { width: range.cols * 256, height: range.rows * 256 });
    } else {
      map.getSource<CanvasSource>(CANVAS)?.setCoordinates(cornersOf(range));
    }
  }

  #show(): void {
    const { map } = this.shown;
    const source = map.getSource<CanvasSource>(CANVAS);
    source?.play();
    if (source || !this.#range) return;
    map.addSource(CANVAS, { type: 'canvas', canvas: this.#canvas, coordinates: cornersOf(this.#range), animate: true });
    const { opacity, layer } = this.store.state;
    const ids = map.getStyle().layers.map(({ id }) => id);
    map.addLayer(
      { id: CANVAS, type: 'raster', source: CANVAS, paint: { 'raster-fade-duration': 0, 'raster-opacity': opacity } },
      ids[ids.indexOf(LAYER) + 1],
    );
    // Two shadows would be twice as dark.
    if (layer === 'shadow' || opacity < 1) this.shown.setOpacity(0);
  }

  /** Goes over to a picture; both together are always a whole one. */
  async #fadeTo(picture: HTMLCanvasElement, hard: boolean, signal: AbortSignal): Promise<void> {
    const pen = this.#canvas.getContext('2d');
    if (!pen) return;
    const from = this.#shown;
    const begin = performance.now();
    const takes = this.still ? CALM_STEP_MS : STEP_MS;
    for (let part = 0; part < 1 && !signal.aborted;) {
      // As it is when the frame is seen: where frames take as long as a step, one shows it whole.
      const drawn = performance.now();
      part = Math.min(1, (drawn - begin + this.#frameMs) / takes);
      const share = hard || this.still || !from ? 1 : part;
      pen.globalCompositeOperation = 'copy';
      pen.globalAlpha = share;
      pen.drawImage(picture, 0, 0);
      if (from && share < 1) {
        // Sums of premultiplied colours: what is transparent in both stays so, what is opaque in both, too.
        pen.globalCompositeOperation = 'lighter';
        pen.globalAlpha = 1 - share;
        pen.drawImage(from, 0, 0);
      }
      this.#show();
      await frame();
      this.#frameMs = performance.now() - drawn;
    }
    this.#shown = picture;
  }

  /** Waits while the page lies hidden behind others. */
  async #whenSeen(signal: AbortSignal): Promise<void> {
    while (document.hidden && !signal.aborted) {
      await new Promise<void>((resolve) => {
        document.addEventListener('visibilitychange', () => resolve(), { once: true });
        signal.addEventListener('abort', () => resolve(), { once: true });
      });
    }
  }
}

/** The times of a day's pictures: while the sun is up, in whole steps; a day without sunrise or sunset goes round the clock. */
export function stepsOf({ sunrise, sunset }: SunDay): number[] {
  const [first, last] = [Math.max(0, Math.ceil((sunrise ?? 0) / STEP_MIN)), Math.min(LAST_STEP, Math.floor((sunset ?? Infinity) / STEP_MIN))];
  const [begin, end] = sunrise === null || sunset === null || last <= first ? [0, LAST_STEP] : [first, last];
  return Array.from({ length: end - begin + 1 }, (_, step) => (begin + step) * STEP_MIN);
}

const same = (one: Range, other: Range) => JSON.stringify(one) === JSON.stringify(other);

const frame = () => new Promise<void>((resolve) => { requestAnimationFrame(() => resolve()); });
