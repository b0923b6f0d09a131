/** The state of the page: level, layer, sun and options. Everything else on the page follows from it. */

/** A product that tiles are served of: one of `LAYER_NAMES`, or another one that the service lists (`layers.ts`). */
export type LayerName = string;
export type Quantity = 'hours' | 'first' | 'last' | 'longest';
export type Theme = 'auto' | 'light' | 'dark';

export const LAYER_NAMES: readonly LayerName[] = ['color', 'shadow', 'sunhours'];
export const QUANTITIES: readonly Quantity[] = ['hours', 'first', 'last', 'longest'];
export const THEMES: readonly Theme[] = ['auto', 'light', 'dark'];

/** Where the map looks: zoom of tiles of 512 pixels, degrees; bearing clockwise from north, pitch from straight down. */
export interface View {
  readonly zoom: number;
  readonly lat: number;
  readonly lon: number;
  readonly bearing: number;
  readonly pitch: number;
}

export interface State {
  /** A level's name; empty until the levels are known. */
  readonly level: string;
  readonly layer: LayerName;
  /** One of the level's `styles`; null: its own. */
  readonly style: string | null;
  /** Whether the sun is that of a moment or stands in a direction; `none`: the level has other lights alone. */
  readonly sunBy: 'time' | 'angles' | 'none';
  /** The moment: date (YYYY-MM-DD) and minutes of the day by a clock that is `offset` (+02:00) before UTC. */
  readonly date: string;
  readonly minutes: number;
  readonly offset: string;
  /** The direction: degrees clockwise from north, and above the horizon. */
  readonly azimuth: number;
  readonly altitude: number;
  /** What of the day's sun the layer `sunhours` shows. */
  readonly quantity: Quantity;
  /** Range of the colours of hours of sun: `day` follows from the date, `fixed` is 0 to 24, `LOW,HIGH` are hours. */
  readonly range: string;
  /** Address of XYZ tiles of a base map below the layer; empty: none. */
  readonly base: string;
  /** How much of the layer is seen over a base map, 0 to 1. */
  readonly opacity: number;
  /** Whether the ground is seen in three dimensions. */
  readonly solid: boolean;
  readonly theme: Theme;
  /** The panel that is open. */
  readonly panel: string;
  /** The view that is shown of a level without a place on the earth; null: its first. */
  readonly shot: string | null;
  /** Null until the map has been placed. */
  readonly view: View | null;
  /** Parts of the address that belong to panels, by their names there: see `own` of `panels.ts`. */
  readonly own: Readonly<Record<string, string>>;
}

export const FIRST_STATE: State = {
  level: '',
  layer: 'color',
  style: null,
  sunBy: 'time',
  date: '2024-06-21',
  minutes: 12 * 60,
  offset: '+00:00',
  azimuth: 315,
  altitude: 30,
  quantity: 'hours',
  range: 'day',
  base: '',
  opacity: 1,
  solid: false,
  theme: 'auto',
  panel: 'map',
  shot: null,
  view: null,
  own: {},
};

type Listener = () => void;

/** Holds the state. Listeners hear of a change after it, and only where what they look at differs. */
export class Store {
  #state: State;
  readonly #listeners = new Set<Listener>();

  constructor(state: State = FIRST_STATE) {
    this.#state = state;
  }

  get state(): State {
    return this.#state;
  }

  set(change: Partial<State>): void {
    const before = this.#state;
    this.#state = { ...before, ...change };
    for (const listener of [...this.#listeners]) listener();
  }

  /** Sets parts of the address that belong to a panel; null takes one away. */
  setOwn(change: Readonly<Record<string, string | null>>): void {
    const own: Record<string, string> = { ...this.#state.own };
    for (const [name, value] of Object.entries(change)) {
      if (value === null) delete own[name];
      else own[name] = value;
    }
    this.set({ own });
  }

  /** Calls `hear` now, and whenever what `select` gives has changed (compared as JSON). Returns what ends that. */
  watch<Value>(select: (state: State) => Value, hear: (value: Value, state: State) => void): () => void {
    let last = select(this.#state);
    let key = JSON.stringify(last);
    hear(last, this.#state);
    const listener = () => {
      last = select(this.#state);
      const next = JSON.stringify(last);
      if (next === key) return;
      key = next;
      hear(last, this.#state);
    };
    this.#listeners.add(listener);
    return () => this.#listeners.delete(listener);
  }
}
