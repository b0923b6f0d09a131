/** Starts the page, and keeps state, levels, map, the sun's controls and panels consistent. */

import { readAddress, writeAddress } from './address';
import './all_panels';
import { BaseMaps } from './base_maps';
import { DayWaitLine } from './day_wait';
import { type Dock, makeDock } from './dock';
import { byId, html } from './dom';
import { Frames } from './frames';
import { hasLegend, layersOf } from './layers';
import { coveredLeft, isSheet } from './layout';
import { LevelMap } from './map';
import { parseMoment } from './moments';
import { notice } from './notice';
import { openingMoment } from './opening';
import { Player } from './player';
import { pictureQuery, sunQuery } from './query';
import type { Readiness } from './readiness';
import { type Level, type PlacedLevel, type Query, Service, inWords, isAbort, isPlaced } from './service';
import { makeShare } from './share';
import { makeSide } from './side';
import { Stage, shotsOf } from './stage';
import { FIRST_STATE, type State, Store } from './state';
import { StartCard, noteOf } from './start_card';
import { Status } from './status';
import { type SunDay, fetchSunDay } from './sun_day';
import { keepTheme } from './theme';
import { Tiles } from './tiles';
import { veil } from './veil';
import { wrongParts } from './wrong_parts';
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
  readonly #status = new Status(() => { this.#tiles.reset(); this.#draw(); this.#learnDay(); }, () => this.#stopPlaying());
  readonly #tiles = new Tiles(service, (progress) => this.#status.progress(progress));
  readonly #shown = new LevelMap(byId('map'), this.#tiles, still);
  readonly #stage = new Stage(byId('stage'), service, store, (waits) => this.#status.working(waits), (words) => this.#status.fail(words));
  readonly #dock: Dock = makeDock(byId('sun'), store, () => this.#togglePlaying());
  readonly #dayWait = new DayWaitLine((note) => this.#status.waitForDay(note));
  readonly #player = new Player(this.#shown, new Frames(this.#tiles), service, store, () => this.#level as PlacedLevel, still, {
    step: ({ minutes, sun }) => {
      this.#stepping = true;
      store.set({ minutes });
      this.#stepping = false;
      this.#dock.showSun(sun);
    },
    waiting: (wait) => {
      this.#dock.showWaiting(wait && wait.ready / wait.all);
      this.#dayWait.see(wait);
    },
    failed: (words) => this.#status.fail(words),
    playing: (plays) => {
      this.#dock.showPlaying(plays);
      this.#dayWait.end();
      if (!plays) this.#draw();
    },
  });
  readonly #start = new StartCard(byId('start'), announce);
  /** Whether the service can draw now, and whether it could before. */
  #ready = false;
  readonly #firstPicture = deferred();
  #wasReady = false;
  #levels: readonly Level[] = [];
  #baseMaps = new BaseMaps();
  #level!: Level;
  #day: SunDay | null = null;
  /** Whether the day is to be played as soon as it is known. */
  #willPlay = false;
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
  async start(asked = service.levels(), askedBaseMaps = service.baseMaps()): Promise<void> {
    const slow = setTimeout(() => veil('Asking the service for its levels …'), 600);
    keepTheme(store, (ground) => this.#shown.map.isStyleLoaded() && this.#shown.paintGround(ground));
    const styled = this.#shown.map.isStyleLoaded() ? Promise.resolve() : this.#shown.map.once('style.load');
    try {
      await styled;
      this.#shown.paintGround(getComputedStyle(document.documentElement).getPropertyValue('--ground').trim());
      [this.#levels, this.#baseMaps] = await Promise.all([asked, askedBaseMaps]);
    } catch (error) {
      veil(`${inWords(error)} There is nothing to show before it does.`, { words: 'Try again', go: () => { veil(null); void this.start(); } }, true);
      return;
    } finally {
      clearTimeout(slow);
    }
    veil(null);
    const placed = this.#levels.filter(isPlaced);
    const first = placed[0] ?? this.#levels[0];
    if (!first) {
      veil('The service has no levels.', undefined, true);
      return;
    }
    this.#level = first;
    const options = (levels: readonly Level[]) => levels.map(({ name, title }) => html('option', { value: name }, title || name));
    const flat = this.#levels.filter((level) => !isPlaced(level));
    byId('level').replaceChildren(...options(placed), ...(flat.length ? [html('optgroup', { label: 'Without a map: pictures of their views' }, ...options(flat))] : []));
    this.#openAddress();
    makeSide((open) => ({
      store, service, open, map: this.#shown.map, levels: this.#levels, baseMaps: this.#baseMaps, level: () => this.#level,
      announce,
    }));
    makeShare(store, announce);
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

  /** Shows what the page's address says, and says what of it means nothing here. */
  #openAddress(): void {
    const said = readAddress(location.hash);
    this.#open(said);
    const wrong = [
      ...wrongParts(location.hash, said, this.#level),
      ...(this.#baseMaps.allows(said.base ?? '') ? [] : ['this service shows its own base maps only']),
    ];
    notice(wrong.length ? `In the address, ${wrong.join('; ')}.` : null);
  }

  /** Shows what an address says; where it says nothing, a level's own. */
  #open(said: Partial<State>): void {
    const level = this.#levels.find(({ name }) => name === said.level) ?? this.#levels.find(isPlaced) ?? (this.#levels[0] as Level);
    // A view saved for a level that is not here says nothing about another.
    const meant = said.level === undefined || said.level === level.name ? said : { theme: said.theme ?? 'auto' };
    notice(null);
    this.#level = level;
    byId<HTMLSelectElement>('level').value = level.name;
    document.title = `${level.title || level.name} · Skugga`;
    this.#stage.open(level);
    this.#dock.setPlace(isPlaced(level), level.time_zone ?? null);
    const { sun } = level;
    const start: State = { ...FIRST_STATE, azimuth: sun?.azimuth ?? FIRST_STATE.azimuth, altitude: sun?.altitude ?? FIRST_STATE.altitude };
    const style = meant.style && level.styles?.includes(meant.style) ? meant.style : null;
    if (!isPlaced(level)) {
      const { own = {}, theme, panel, shot } = meant;
      // Only what is set of shadows means anything without a map.
      const settings = Object.fromEntries(Object.entries(own).filter(([name]) => name.startsWith('plan-')));
      store.set({
        ...start, level: level.name, style, own: settings, theme: theme ?? 'auto', panel: panel ?? 'views', sunBy: sun ? 'angles' : 'none',
        azimuth: meant.azimuth ?? start.azimuth, altitude: meant.altitude ?? start.altitude,
        shot: shot && shotsOf(level).includes(shot) ? shot : null,
      });
      this.#shown.showSolid(null, true);
      this.#shown.hideLayer();
      this.#sayWhetherSeen();
      return;
    }
    const byAngles = sun?.time === undefined && sun?.azimuth !== undefined && !level.sun_is_default;
    store.set({
      ...start,
      ...(parseMoment(sun?.time) ?? openingMoment(level)),
      sunBy: byAngles ? 'angles' : 'time',
      ...meant,
      style,
      shot: null,
      layer: layersOf(level).find(({ name }) => name === meant.layer)?.name ?? FIRST_STATE.layer,
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
    if (!isPlaced(this.#level)) return;
    const [side, dock] = [byId('side').getBoundingClientRect(), byId('sun').getBoundingClientRect()];
    const room = window.innerHeight <= 500 ? 8 : 20;
    const left = isSheet() ? room : Math.max(coveredLeft(), side.right) + room;
    const bottom = (isSheet() ? window.innerHeight - Math.min(side.top, dock.top) : window.innerHeight - dock.top) + room;
    const small = window.innerWidth - left < 200 || window.innerHeight - bottom < 200;
    this.#shown.fit(this.#level, small ? { top: 0, bottom: 0, left: 0, right: 0 } : { top: room, right: room, left, bottom });
  }

  #sayWhetherSeen(): void {
    if (!isPlaced(this.#level) || this.#shown.sees(this.#level)) veil(null);
    else veil(`Nothing is known here. ${this.#level.title || this.#level.name} lies elsewhere.`, { words: 'Take me there', go: () => this.#fit() });
  }

  // --- keeping in step ------------------------------------------------------------------------------------------------

  #listen(): void {
    const { map } = this.#shown;
    byId<HTMLSelectElement>('level').addEventListener('change', (event) => {
      this.#stopPlaying();
      const { theme, panel, base, opacity } = store.state;
      this.#open({ level: (event.target as HTMLSelectElement).value, theme, panel, base, opacity });
    });
    window.addEventListener('hashchange', () => this.#openAddress());
    map.on('moveend', () => {
      if (!isPlaced(this.#level)) return;
      store.set({ view: this.#shown.view });
      this.#sayWhetherSeen();
    });
    store.watch(({ base }) => base, (base) => this.#shown.showBase(this.#baseMaps.source(base)));
    store.watch(({ opacity }) => opacity, (opacity) => this.#shown.setOpacity(opacity));
    store.watch(({ level, solid }) => [level, solid], (_, { solid }) => {
      const level = this.#level;
      const template = service.tiles(level.name, { layer: TERRAIN });
      this.#shown.showSolid(solid && isPlaced(level) ? { template, level } : null, still);
    });
    store.watch((state) => [state.level, state.shot, pictureQuery(state)], () => {
      if (this.#stepping) return;
      delete document.body.dataset.shown; // what is drawn is no longer what is asked for
      // Somebody moves the sun, or wants another layer: the day stops.
      this.#stopPlaying();
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
    const level = this.#level;
    this.#status.subject(isPlaced(level) && state.layer === 'sunhours' ? 'Drawing hours of sun' : '');
    if (!isPlaced(level)) {
      this.#dock.showSun(state.sunBy === 'angles' ? { azimuth: state.azimuth, altitude: state.altitude } : null);
      void this.#stage.draw(level, state).then((shown) => {
        if (shown && !signal.aborted) document.body.dataset.shown = JSON.stringify(query);
      });
      return;
    }
    // Before that tiles would wait in the map's own queue, and those of a base map behind them.
    if (this.#ready) this.#showPicture(level, query, signal);
    const sun = state.layer === 'sunhours' ? sunQuery(state) : query;
    service.tileJson(level.name, sun, signal).then(
      ({ skugga }) => this.#dock.showSun(skugga.sun),
      (error: unknown) => {
        if (!isAbort(error)) this.#status.fail(inWords(error));
      },
    );
  }

  #showPicture(level: PlacedLevel, query: Query, signal: AbortSignal): void {
    // Colours that stand for numbers have a legend: below it, those of before would say something wrong.
    const { layer, quantity, date, range } = store.state;
    this.#shown.showLayer(JSON.stringify([level.name, hasLegend(level, layer) && [layer, quantity, date, range]]), {
      attribution: level.attribution, bounds: level.bounds,
      minzoom: level.minzoom, maxzoom: level.maxzoom, tiles: [service.tiles(level.name, query)],
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
    if (this.#day?.offset !== offset || !isPlaced(level)) this.#day = null;
    if (!isPlaced(level)) {
      this.#dock.showDay(null);
      return;
    }
    try {
      // A first start has to compile what the day needs, while the map could be drawn.
      await this.#firstPicture.promise;
      if (signal.aborted) return;
      const day = await fetchSunDay(service, level, date, offset, signal);
      this.#day = day;
      this.#dock.showDay(day);
      if (this.#willPlay && day) this.#play(day);
      else if (this.#willPlay) this.#stopPlaying();
    } catch (error) {
      if (isAbort(error)) return;
      this.#stopPlaying();
      this.#dock.showDay(null);
      this.#status.fail(inWords(error));
    }
  }

  // --- playing the day ------------------------------------------------------------------------------------------------

  #togglePlaying(): void {
    if (this.#player.plays || this.#willPlay) this.#stopPlaying();
    else if (isPlaced(this.#level) && this.#wasReady && store.state.layer !== 'sunhours') {
      if (this.#day) this.#play(this.#day);
      else {
        this.#willPlay = true;
        this.#dock.showPlaying(true);
        this.#status.waitForDay({ words: 'The day begins as soon as its sunrise is known', count: '', quiet: false });
      }
    }
  }

  #play(day: SunDay): void {
    this.#willPlay = false;
    this.#status.waitForDay(null);
    store.set({ sunBy: 'time' });
    void this.#player.play(day);
  }

  #stopPlaying(): void {
    if (this.#willPlay) {
      this.#dock.showPlaying(false);
      this.#status.waitForDay(null);
    }
    this.#willPlay = false;
    if (this.#player.plays) this.#player.stop();
  }
}

// Asked for before the map is made, which takes a while.
void service.readiness.check();
const askedBaseMaps = service.baseMaps();
const asked = service.levels();
asked.catch(() => {}); // told of where it is awaited
try {
  void new Page().start(asked, askedBaseMaps);
} catch {
  veil('This browser cannot draw the map: it has no WebGL 2.', undefined, true);
}
