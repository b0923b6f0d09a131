/** Client of the service's HTTP API. Every failure becomes an Error with a message for users. */

import { type BaseMap, BaseMaps } from './base_maps';
import { GATEWAY_ERRORS, ReadinessPoll } from './readiness';

const BUSY = 503;
const ATTEMPTS = 6;

export const TILE_MATRIX_SET = 'WebMercatorQuad';

/** A level as `/levels` tells of it. */
export interface Level {
  readonly name: string;
  readonly title: string;
  readonly attribution: string | null;
  /** West, south, east, north in degrees; null where the level has no place on the earth. */
  readonly bounds: readonly [number, number, number, number] | null;
  readonly minzoom: number | null;
  readonly maxzoom: number | null;
  readonly views: readonly string[];
  readonly view_kinds: Readonly<Record<string, { readonly kind: string; readonly size: readonly [number, number] | null }>>;
  readonly lights: Readonly<Record<string, { readonly kind: string }>>;
  readonly layers: readonly string[];
  /** What passes leave behind on the way to a picture. */
  readonly layers_between: readonly string[];
  readonly map_layers: readonly string[];
  readonly products?: readonly {
    readonly name: string;
    readonly about: string;
    readonly when: 'none' | 'sun' | 'days';
    readonly legend: boolean;
  }[];
  readonly algorithms: readonly string[];
  readonly sun: { readonly time?: string; readonly azimuth?: number; readonly altitude?: number } | null;
  /** Whether the level names no sun: `sun` is then one that the service chose. */
  readonly sun_is_default?: boolean;
  /** Of its middle, as Europe/Oslo; null where it has no place or none is known. */
  readonly time_zone?: string | null;
  readonly warnings: readonly string[];
  readonly styles?: readonly string[];
  readonly style?: string;
}

/** A level that maps can show. */
export type PlacedLevel = Level & {
  readonly bounds: readonly [number, number, number, number];
  readonly minzoom: number;
  readonly maxzoom: number;
};

export function isPlaced(level: Level): level is PlacedLevel {
  return level.bounds !== null && level.minzoom !== null && level.maxzoom !== null;
}

export interface SunPlace {
  readonly time?: string;
  readonly azimuth: number;
  readonly altitude: number;
}

export interface LegendEntry {
  readonly value: number;
  readonly label: string;
  readonly color: string;
}

export interface Legend {
  readonly title: string;
  readonly low: number;
  readonly high: number;
  readonly picture: string;
  readonly entries: readonly LegendEntry[];
}

export interface TileJson {
  readonly name: string;
  readonly attribution: string | null;
  readonly tiles: readonly string[];
  readonly minzoom: number;
  readonly maxzoom: number;
  readonly bounds: readonly [number, number, number, number];
  readonly skugga: { readonly layer: string; readonly sun: SunPlace | null; readonly legend?: Legend };
}

export type Query = Readonly<Record<string, string | number | null | undefined>>;

/** `early`: answered without anything drawn, so also before the service can draw. All other requests wait for that. */
export interface ServiceInit extends RequestInit {
  readonly early?: boolean;
}

/** What keeps a request from its answer; `status` is that of HTTP, or null where there was no answer at all. */
export class ServiceError extends Error {
  constructor(message: string, readonly status: number | null) {
    super(message);
  }
}

export function isAbort(error: unknown): boolean {
  return error instanceof DOMException && error.name === 'AbortError';
}

/** What to tell a person of a failure. */
export function inWords(error: unknown): string {
  return error instanceof Error ? error.message : String(error);
}

export class Service {
  readonly readiness = new ReadinessPoll(this.address('readyz'));

  /** The address of a path of the service, which may be mounted under a prefix. Null and undefined are left out of the query. */
  address(path: string, query: Query = {}): string {
    const url = new URL(path, document.baseURI);
    url.hash = '';
    for (const [name, value] of Object.entries(query)) {
      if (value !== null && value !== undefined) url.searchParams.set(name, String(value));
    }
    return url.href;
  }

  /** The address of something of a level: `of('jacksboro', 'point', {lon, lat})`. */
  of(level: string, path: string, query: Query = {}): string {
    return this.address(`levels/${encodeURIComponent(level)}/${path}`, query);
  }

  /** The template of a level's tiles, with {z}, {x} and {y}. */
  tiles(level: string, query: Query, suffix = 'png'): string {
    const address = this.of(level, `tiles/${TILE_MATRIX_SET}/_z_/_x_/_y_.${suffix}`, query);
    return address.replace('_z_/_x_/_y_', '{z}/{x}/{y}');
  }

  async levels(signal?: AbortSignal): Promise<Level[]> {
    return this.json<Level[]>(this.address('levels'), signal, { early: true });
  }

  /** The base maps that are offered; none where the service cannot say. */
  async baseMaps(): Promise<BaseMaps> {
    try {
      const { base_maps: offered, only } = await this.json<{ base_maps: BaseMap[]; only: boolean }>(this.address('base-maps.json'), undefined, { early: true });
      return new BaseMaps(offered, only, this.address(''));
    } catch {
      return new BaseMaps();
    }
  }

  async tileJson(level: string, query: Query, signal?: AbortSignal): Promise<TileJson> {
    return this.json<TileJson>(this.of(level, `${TILE_MATRIX_SET}/tilejson.json`, query), signal, { early: true });
  }

  /** The answer as JSON; `init` for another method than GET. Throws as `request` does. */
  async json<Answer>(address: string, signal?: AbortSignal, init: ServiceInit = {}): Promise<Answer> {
    const response = await this.request(address, { ...init, signal });
    try {
      return (await response.json()) as Answer;
    } catch (error) {
      if (isAbort(error)) throw error;
      throw new ServiceError('The service sent something that is not JSON.', response.status);
    }
  }

  /**
   * Fetches as soon as the service can answer; asks again while it says that it is busy, and after it was away.
   * Throws a `ServiceError` in words; an abort is passed on as it is.
   */
  async request(address: string, { early = false, ...init }: ServiceInit = {}): Promise<Response> {
    for (let attempt = 1; ; attempt += 1) {
      // Drawn before the service is ready, six pictures would hold all of the browser's connections.
      if (!early) await this.readiness.until(['ready'], init.signal);
      let response: Response | null = null;
      try {
        response = await fetch(address, init);
      } catch (error) {
        if (isAbort(error)) throw error;
      }
      if (response?.ok) return response;
      if (!response || GATEWAY_ERRORS.has(response.status)) {
        const { phase } = await this.readiness.check();
        if (phase === 'ready' || attempt === ATTEMPTS) {
          throw new ServiceError(response ? await problem(response) : 'The service does not answer.', response?.status ?? null);
        }
        if (phase === 'starting') await pause(1000, init.signal);
        else await this.readiness.until(['starting', 'ready'], init.signal);
        continue;
      }
      if (response.status !== BUSY || attempt === ATTEMPTS) throw new ServiceError(await problem(response), response.status);
      await pause(1000 * (Number(response.headers.get('Retry-After')) || attempt), init.signal);
    }
  }
}

/** What went wrong, from a problem document (RFC 9457) where there is one. */
async function problem(response: Response): Promise<string> {
  let document: { detail?: unknown; title?: unknown } = {};
  try {
    document = await response.json();
  } catch {
    // No problem document: the status has to do.
  }
  const said = [document.detail, document.title].find((text) => typeof text === 'string' && text);
  return `${said ?? (response.statusText || 'The service refused')} (${response.status})`;
}

function pause(milliseconds: number, signal?: AbortSignal | null): Promise<void> {
  return new Promise((resolve, reject) => {
    const abort = () => {
      clearTimeout(timer);
      reject(new DOMException('aborted', 'AbortError'));
    };
    const timer = setTimeout(() => {
      signal?.removeEventListener('abort', abort);
      resolve();
    }, milliseconds);
    signal?.addEventListener('abort', abort, { once: true });
  });
}
