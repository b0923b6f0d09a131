/** Plays a day: moves the sun from sunrise to sunset, and updates the map. */

import { type ComparedMap, comparedMap } from './compared_map';
import { FrameCanvas, same } from './frame_canvas';
import { type FrameProgress, type Frames, type Range, rangeOver, tilesOfEach } from './frames';
import type { LevelMap } from './map';
import { DAY_MINUTES } from './moments';
import { pictureQuery } from './query';
import { type PlacedLevel, type Service, type SunPlace, inWords, isAbort } from './service';
import type { State, Store } from './state';
import type { SunDay } from './sun_day';

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
  readonly #own: FrameCanvas;
  /** The canvas of the map that is compared. */
  #other: { readonly compared: ComparedMap; readonly canvas: FrameCanvas } | null = null;
  readonly #suns = new Map<string, SunPlace | null>();
  #ending: AbortController | null = null;
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
  ) {
    this.#own = new FrameCanvas(shown.map);
  }

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
    this.#own.clear();
    this.shown.setOpacity(this.store.state.opacity);
    const other = this.#other;
    this.#other = null;
    if (other && comparedMap() === other.compared) void other.compared.release().then(() => {
      // Played again meanwhile, it has another canvas, of the same name on the map.
      if (!this.#other && comparedMap() === other.compared) other.canvas.clear();
    });
  }

  /** Plays a day round and round until `stop`, from the present time on if the sun is up then. */
  async play(day: SunDay): Promise<void> {
    this.stop();
    const ending = new AbortController();
    this.#ending = ending;
    this.news.playing(true);
    const steps = stepsOf(day);
    this.#most = tilesOfEach(steps.length * (comparedMap() ? 2 : 1));
    let wrong = '';
    let at = Math.max(0, steps.findIndex((minutes) => minutes >= this.store.state.minutes));
    try {
      for (let fresh = true; !ending.signal.aborted; fresh = false) {
        const minutes = steps[at] ?? 0;
        const pictures = await this.#next(steps, at, ending.signal);
        await this.#whenSeen(ending.signal);
        await this.#fadeTo(pictures, fresh || at === 0, ending.signal);
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
        this.#own.pause();
        this.#otherCanvas()?.pause();
        this.news.playing(false);
        if (wrong) this.news.failed(wrong);
      }
    }
  }

  /** The pictures of a step on all maps, for what is seen now; more are asked for ahead meanwhile. */
  async #next(steps: readonly number[], at: number, signal: AbortSignal): Promise<HTMLCanvasElement[]> {
    for (;;) {
      const range = this.#rangeSeen();
      const minutes = steps[at] ?? 0;
      const compared = comparedMap();
      // The picture that is wanted now is asked for before those that come after it.
      const picture = this.#made(minutes, range) ?? this.#waitFor(steps, at, range, signal);
      void this.#fetchAhead(steps, at, range, signal);
      const whole = await picture;
      // Somebody may have moved the map meanwhile, or compared it with another.
      if (same(range, this.#rangeSeen()) && compared === comparedMap()) {
        this.#own.lay(range);
        this.#joinCompared(compared)?.lay(range);
        return whole;
      }
    }
  }

  /** The canvas of the compared map from now on; null: none is compared. */
  #joinCompared(compared: ComparedMap | null): FrameCanvas | null {
    if (this.#other?.compared !== compared) this.#other = compared && { compared, canvas: new FrameCanvas(compared.map) };
    compared?.hold();
    return this.#other?.canvas ?? null;
  }

  /** The canvas of a map that is still compared. */
  #otherCanvas(): FrameCanvas | null {
    return this.#other && comparedMap() === this.#other.compared ? this.#other.canvas : null;
  }

  /** The pictures of a time on all maps, if all are ready. */
  #made(minutes: number, range: Range): HTMLCanvasElement[] | undefined {
    const made = this.#templates(minutes).map((template) => this.frames.get(template, range));
    return made.every((picture) => picture !== undefined) ? made : undefined;
  }

  /** Loads a picture, and tells how far it is meanwhile. */
  async #waitFor(steps: readonly number[], at: number, range: Range, signal: AbortSignal): Promise<HTMLCanvasElement[]> {
    const minutes = steps[at] ?? 0;
    const tell = () => this.news.waiting({
      minutes, tiles: this.#progress(minutes, range), all: steps.length,
      ready: steps.filter((each) => this.#made(each, range)).length,
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

  /** How many tiles of a time's pictures are there, of those that are on their way. */
  #progress(minutes: number, range: Range): FrameProgress | null {
    const parts = this.#templates(minutes).map((template) => this.frames.progress(template, range)).filter((part) => part !== undefined);
    return parts.length ? parts.reduce((sum, { done, all }) => ({ done: sum.done + done, all: sum.all + all }), { done: 0, all: 0 }) : null;
  }

  async #fetchAhead(steps: readonly number[], at: number, range: Range, signal: AbortSignal): Promise<void> {
    if (this.#fetching) return;
    this.#fetching = true;
    try {
      const wanted = Array.from({ length: Math.min(AHEAD, steps.length - 1) }, (_, ahead) => steps[(at + 1 + ahead) % steps.length] ?? 0)
        .filter((minutes) => !this.#made(minutes, range));
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

  async #load(minutes: number, range: Range, signal: AbortSignal): Promise<HTMLCanvasElement[]> {
    const template = this.#template(minutes);
    const sun = this.#suns.has(template) ? null : this.service.tileJson(this.level().name, pictureQuery(this.#state(minutes)), signal)
      .then(({ skugga }) => this.#suns.set(template, skugga.sun));
    const [pictures] = await Promise.all([
      Promise.all(this.#templates(minutes).map((each) => this.frames.load(each, range, signal))), sun,
    ]);
    return pictures;
  }

  #state(minutes: number): State {
    return { ...this.store.state, minutes, sunBy: 'time' };
  }

  #template(minutes: number): string {
    return this.service.tiles(this.level().name, pictureQuery(this.#state(minutes)));
  }

  /** The tiles of a time: of the map, and of the one that is compared. */
  #templates(minutes: number): string[] {
    const compared = comparedMap();
    return [this.#template(minutes), ...(compared ? [this.service.tiles(this.level().name, compared.query(this.#state(minutes)))] : [])];
  }

  #rangeSeen(): Range {
    const { map } = this.shown;
    const [seen, level] = [map.getBounds(), this.level()];
    const range = rangeOver(
      [seen.getWest(), seen.getSouth(), seen.getEast(), seen.getNorth()], level.bounds, this.shown.tileZoom(level), level.minzoom, this.#most,
    );
    // Nothing of the level is seen: what was seen last goes on.
    return range ?? this.#own.range ?? (rangeOver(level.bounds, level.bounds, level.minzoom, level.minzoom) as Range);
  }

  /** Goes over to the pictures of a step, on all maps at once. */
  async #fadeTo(pictures: readonly HTMLCanvasElement[], hard: boolean, signal: AbortSignal): Promise<void> {
    const begin = performance.now();
    const takes = this.still ? CALM_STEP_MS : STEP_MS;
    const { opacity, layer } = this.store.state;
    const shown = () => [this.#own, this.#otherCanvas()].flatMap((canvas, index) => {
      const picture = pictures[index];
      return canvas?.range && picture ? [{ canvas, picture }] : [];
    });
    for (let part = 0; part < 1 && !signal.aborted;) {
      // As it is when the frame is seen: where frames take as long as a step, one shows it whole.
      const drawn = performance.now();
      part = Math.min(1, (drawn - begin + this.#frameMs) / takes);
      for (const { canvas, picture } of shown()) {
        canvas.paint(picture, hard || this.still ? 1 : part);
        canvas.show(opacity, layer === 'shadow' || opacity < 1 || canvas !== this.#own);
      }
      await frame();
      this.#frameMs = performance.now() - drawn;
    }
    for (const { canvas, picture } of shown()) canvas.keep(picture);
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

const frame = () => new Promise<void>((resolve) => { requestAnimationFrame(() => resolve()); });
