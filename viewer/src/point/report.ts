/** Types of the service's reports on the sun at a point (`/levels/NAME/point` and `/levels/NAME/point/sun.json`). */

export interface Caster {
  readonly kind: 'relief' | 'building' | 'mesh' | 'forest';
  readonly distance_m: number;
  /** Degrees clockwise from true north. */
  readonly azimuth: number;
  /** Degrees above the eye's level. */
  readonly elevation: number;
  readonly height_m: number;
  readonly lon: number | null;
  readonly lat: number | null;
}

export interface Now {
  readonly time: string | null;
  readonly azimuth: number;
  readonly altitude: number;
  readonly lit: boolean;
  readonly by: Caster | null;
}

/** Direct sun from `begin` to `end`; what hid it before (`after`) and hides it then (`before`). */
export interface Interval {
  readonly begin: string;
  readonly end: string;
  readonly after: Caster | null;
  readonly before: Caster | null;
}

export interface Day {
  readonly date: string;
  readonly clock: string;
  readonly sunrise: string | null;
  readonly first_sun: string | null;
  readonly last_sun: string | null;
  readonly sunset: string | null;
  readonly noon: string;
  readonly noon_altitude: number;
  readonly daylight_h: number;
  readonly direct_h: number;
  readonly masked_h: number;
  readonly sunlit: readonly Interval[];
  readonly remark: string | null;
}

export interface Report {
  readonly level: string;
  readonly lon: number | null;
  readonly lat: number | null;
  readonly elevation_m: number | null;
  readonly height_m: number;
  readonly now: Now | null;
  readonly day: Day | null;
  readonly remark: string | null;
}

export interface Sky {
  readonly date: string;
  readonly horizon: {
    readonly azimuth: readonly number[];
    readonly relief: readonly number[];
    readonly solids: readonly number[];
    readonly forest: readonly number[];
  };
  readonly path: readonly { readonly time: string; readonly azimuth: number; readonly altitude: number; readonly lit: boolean }[];
}
