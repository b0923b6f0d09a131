/** Starts the page: state from the address, levels from the service, the map, the sun's dock and the panels; and keeps them in step. */

import { readAddress, writeAddress } from './address';
import './all_panels';
import { type Dock, makeDock } from './dock';
import { byId, html } from './dom';
import { Frames } from './frames';
import { LevelMap } from './map';
import { noonToday, parseMoment } from './moments';
import { Player } from './player';
import { pictureQuery, sunQuery } from './query';
import type { Readiness } from './readiness';
import { type Level, type PlacedLevel, type Query, Service, inWords, isAbort, isPlaced } from './service';
import { makeSide } from './side';
import { FIRST_STATE, type State, Store } from './state';
import { StartCard, noteOf } from './start_card';
import { Status } from './status';
import { type SunDay, fetchSunDay } from './sun_day';
import { keepTheme } from './theme';
import { Tiles } from './tiles';
import { veil } from './veil';
import './style.css'; // after MapLibre's, which it adjusts

/** Milliseconds without a change before a slider's value is drawn, and before the address is written. */
const CALM_MS = 60;
const WRITTEN_MS = 250;
const TERRAIN = 'terrain-rgb';
/** Milliseconds for which the map has the service to itself, at most. */
const FIRST_PICTURE_MS = 20_000;

/** A promise that is resolved from outside. */
function deferred(): { readonly promise: Promise<void>; readonly resolve: () => void } {
  let resolve = () => {};
  const promise = new Promise<void>((done) => {
    resolve = done;
  });
  return { promise, resolve: () => resolve() };
}

const store = new Store({ ...FIRST_STATE, ...readAddress(location.hash) });
const service = new Service();
const still = matchMedia('(prefers-reduced-motion: reduce)').matches;

/** Says something in a line to everybody, screen readers included. */
const announce = (words: string) => { byId('said').textContent = words; };

class Page {
  readonly #status = new Status(() => { this.#tiles.reset(); this.#draw(); this.#learnDay(); });
  readonly #tiles = new Tiles(service, (progress) => this.#status.progress(progress));
  readonly #shown = new LevelMap(byId('map'), this.#tiles, still);
  readonly #dock: Dock = makeDock(byId('sun'), store, () => this.#togglePlaying());
  readonly #player = new Player(this.#shown, new Frames(this.#tiles), service, store, () => this.#level, still, {
    step: ({ minutes, sun }) => {
      this.#stepping = true;
      store.set({ minutes });
      this.#stepping = false;
      this.#dock.showSun(sun);
    },
    waiting: (waits, ready, all) => this.#dock.showWaiting(waits ? ready / all : null),
    failed: (words) => this.#status.fail(words),
    playing: (plays) => {
      this.#dock.showPlaying(plays);
      if (!plays) this.#draw();
    },
  });
  readonly #start = new StartCard(byId('start'), announce);
  /** Whether the service can draw now, and whether it could before. */
  #ready = false;
  readonly #firstPicture = deferred();
  #wasReady = false;
  #levels: readonly Level[] = [];
  #level!: PlacedLevel;
  #day: SunDay | null = null;
  #stepping = false;
  #asking = new AbortController();
  #learning = new AbortController();
  #timers: Record<'draw' | 'write', ReturnType<typeof setTimeout> | undefined> = { draw: undefined, write: undefined };

  constructor() {
    service.readiness.watch((readiness) => this.#follow(readiness));
    // What lies beside the dock has to know how high it is.
    new ResizeObserver(([entry]) => {
      document.documentElement.style.setProperty('--dock', `${entry?.target.clientHeight ?? 0}px`);
    }).observe(byId('sun'));
  }

  /** Reads the levels and begins; where that fails, says so with a way to try again. */
  async start(asked = service.levels()): Promise<void> {
    const slow = setTimeout(() => veil('Asking the service for its levels …'), 600);
    keepTheme(store, (ground) => this.#shown.map.isStyleLoaded() && this.#shown.paintGround(ground));
    const styled = this.#shown.map.isStyleLoaded() ? Promise.resolve() : this.#shown.map.once('style.load');
    try {
      await styled;
      this.#shown.paintGround(getComputedStyle(document.documentElement).getPropertyValue('--ground').trim());
      this.#levels = await asked;
    } catch (error) {
      veil(`${inWords(error)} There is nothing to show before it does.`, { words: 'Try again', go: () => { veil(null); void this.start(); } }, true);
      return;
    } finally {
      clearTimeout(slow);
    }
    veil(null);
    const placed = this.#levels.filter(isPlaced);
    if (!placed[0]) {
      veil(this.#levels.length ? 'No level here has a place on the earth, so there is no map to show.' : 'The service has no levels.', undefined, true);
      return;
    }
    this.#level = placed[0];
    byId('level').replaceChildren(...this.#levels.map((level) => html(
      'option', { value: level.name, disabled: !isPlaced(level) }, level.title || level.name,
    )));
    this.#open(readAddress(location.hash));
    makeSide((open) => ({
      store, service, open, map: this.#shown.map, levels: this.#levels, level: () => this.#level,
      announce,
    }));
    this.#listen();
  }

  /** Shows how far the service is; once it can draw, the map begins by itself, also after the service was away. */
  #follow(readiness: Readiness): void {
    const { phase } = readiness;
    const begins = phase === 'ready' && !this.#ready;
    this.#ready = phase === 'ready';
    this.#wasReady ||= this.#ready;
    this.#dock.allowPlaying(this.#wasReady);
    if (!this.#wasReady) this.#start.show(readiness);
    else if (this.#start.isShown) {
      this.#start.hide();
      announce('The service is ready. The map is being drawn.');
    }
    this.#status.note(this.#wasReady ? noteOf(readiness) : null);
    // Before the level is known, `#listen` draws it.
    if (begins && this.#level) this.#drawSoon();
    if (begins) setTimeout(this.#firstPicture.resolve, FIRST_PICTURE_MS);
  }

  // --- levels and places ----------------------------------------------------------------------------------------------

  /** Shows what an address says; where it says nothing, a level's own. */
  #open(said: Partial<State>): void {
    const placed = this.#levels.filter(isPlaced);
    const level = placed.find(({ name }) => name === said.level) ?? (placed[0] as PlacedLevel);
    // A view saved for a level that is not here says nothing about another.
    const meant = said.level === undefined || said.level === level.name ? said : { theme: said.theme ?? 'auto' };
    this.#level = level;
    byId<HTMLSelectElement>('level').value = level.name;
    document.title = `${level.title || level.name} · Skugga`;
    const [west, , east] = level.bounds;
    const own = level.sun ?? {};
    const layer = meant.layer && level.map_layers.includes(meant.layer) ? meant.layer : FIRST_STATE.layer;
    store.set({
      ...FIRST_STATE,
      ...(parseMoment(own.time) ?? noonToday((west + east) / 2)),
      azimuth: own.azimuth ?? FIRST_STATE.azimuth,
      altitude: own.altitude ?? FIRST_STATE.altitude,
      sunBy: own.time === undefined && own.azimuth !== undefined ? 'angles' : 'time',
      ...meant,
      layer,
      level: level.name,
    });
    const { solid, view } = store.state;
    // The zoom limits of the level before would hold the new view back.
    this.#shown.limitZoom(null);
    this.#shown.showSolid(solid ? { template: service.tiles(level.name, { layer: TERRAIN }), level } : null, true);
    if (view) this.#shown.look(view);
    else this.#fit();
    this.#shown.limitZoom(level);
    store.set({ view: this.#shown.view });
    this.#sayWhetherSeen();
  }

  /** All of the level, beside what covers the map's edges. */
  #fit(): void {
    const [side, dock] = [byId('side').getBoundingClientRect(), byId('sun').getBoundingClientRect()];
    const phone = window.innerWidth <= 700;
    const room = 20;
    const left = phone ? room : side.right + room;
    const bottom = (phone ? window.innerHeight - Math.min(side.top, dock.top) : window.innerHeight - dock.top) + room;
    const small = window.innerWidth - left < 200 || window.innerHeight - bottom < 200;
    this.#shown.fit(this.#level, small ? { top: 0, bottom: 0, left: 0, right: 0 } : { top: room, right: room, left, bottom });
  }

  #sayWhetherSeen(): void {
    if (this.#shown.sees(this.#level)) veil(null);
    else veil(`Nothing is known here. ${this.#level.title || this.#level.name} lies elsewhere.`, { words: 'Take me there', go: () => this.#fit() });
  }

  // --- keeping in step ------------------------------------------------------------------------------------------------

  #listen(): void {
    const { map } = this.#shown;
    byId<HTMLSelectElement>('level').addEventListener('change', (event) => {
      this.#player.stop();
      const { theme, panel, base, opacity } = store.state;
      this.#open({ level: (event.target as HTMLSelectElement).value, theme, panel, base, opacity });
    });
    window.addEventListener('hashchange', () => this.#open(readAddress(location.hash)));
    map.on('moveend', () => {
      store.set({ view: this.#shown.view });
      this.#sayWhetherSeen();
    });
    store.watch(({ base }) => base, (base) => this.#shown.showBase(base));
    store.watch(({ opacity }) => opacity, (opacity) => this.#shown.setOpacity(opacity));
    store.watch(({ level, solid }) => [level, solid], (_, { solid }) => {
      const template = service.tiles(this.#level.name, { layer: TERRAIN });
      this.#shown.showSolid(solid ? { template, level: this.#level } : null, still);
    });
    store.watch((state) => [state.level, pictureQuery(state)], () => {
      if (this.#stepping) return;
      delete document.body.dataset.shown; // what is drawn is no longer what is asked for
      // Somebody moves the sun, or wants another layer: the day stops.
      if (this.#player.plays) this.#player.stop();
      this.#drawSoon();
    });
    store.watch(({ level, date, offset }) => [level, date, offset], () => this.#learnDay());
    store.watch(writeAddress, () => {
      clearTimeout(this.#timers.write);
      // Whoever drives the page by a program can read off whether the address is behind.
      document.body.dataset.written = 'false';
      this.#timers.write = setTimeout(() => {
        history.replaceState(null, '', writeAddress(store.state));
        document.body.dataset.written = 'true';
      }, WRITTEN_MS);
    });
    window.addEventListener('keydown', (event) => {
      const busy = (event.target as Element).closest('input, select, textarea, button, a, [contenteditable], .maplibregl-canvas, [role="slider"]');
      if (event.key !== ' ' || busy || event.defaultPrevented) return;
      event.preventDefault();
      this.#togglePlaying();
    });
  }

  #drawSoon(): void {
    clearTimeout(this.#timers.draw);
    this.#timers.draw = setTimeout(() => this.#draw(), CALM_MS);
  }

  /** Asks for the tiles of the present state and shows them; where the sun stands is asked for beside them. */
  #draw(): void {
    if (this.#player.plays) return;
    const { state } = store;
    const query = pictureQuery(state);
    delete document.body.dataset.shown;
    this.#tiles.reset();
    this.#status.clear();
    this.#asking.abort();
    this.#asking = new AbortController();
    const { signal } = this.#asking;
    // Before that tiles would wait in the map's own queue, and those of a base map behind them.
    if (this.#ready) this.#showPicture(query, signal);
    const sun = state.layer === 'sunhours' ? sunQuery(state) : query;
    service.tileJson(this.#level.name, sun, signal).then(
      ({ skugga }) => this.#dock.showSun(skugga.sun),
      (error: unknown) => {
        if (!isAbort(error)) this.#status.fail(inWords(error));
      },
    );
  }

  #showPicture(query: Query, signal: AbortSignal): void {
    this.#shown.showLayer(this.#level.name, {
      attribution: this.#level.attribution, bounds: this.#level.bounds,
      minzoom: this.#level.minzoom, maxzoom: this.#level.maxzoom, tiles: [service.tiles(this.#level.name, query)],
    });
    this.#shown.setOpacity(store.state.opacity);
    void this.#shown.map.once('idle').then(() => {
      this.#firstPicture.resolve();
      if (signal.aborted) return;
      // The day's last picture lay above until the map below had its own.
      this.#player.clear();
      // Whoever drives the page by a program can read off what is drawn.
      document.body.dataset.shown = JSON.stringify(query);
    });
  }

  async #learnDay(): Promise<void> {
    this.#learning.abort();
    this.#learning = new AbortController();
    const { signal } = this.#learning;
    const { date, offset } = store.state;
    const level = this.#level;
    if (this.#day?.offset !== offset) this.#day = null;
    try {
      // A first start has to compile what the day needs, while the map could be drawn.
      await this.#firstPicture.promise;
      if (signal.aborted) return;
      const day = await fetchSunDay(service, level, date, offset, signal);
      this.#day = day;
      this.#dock.showDay(day);
    } catch (error) {
      if (isAbort(error)) return;
      this.#dock.showDay(null);
      this.#status.fail(inWords(error));
    }
  }

  #togglePlaying(): void {
    if (this.#player.plays) this.#player.stop();
    else if (this.#day && store.state.layer !== 'sunhours') {
      store.set({ sunBy: 'time' });
      void this.#player.play(this.#day);
    }
  }
}

// Asked for before the map is made, which takes a while.
void service.readiness.check();
const asked = service.levels();
asked.catch(() => {}); // told of where it is awaited
try {
  void new Page().start(asked);
} catch {
  veil('This browser cannot draw the map: it has no WebGL 2.', undefined, true);
}
